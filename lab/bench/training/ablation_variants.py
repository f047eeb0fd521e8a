"""The paper's ablation: the motion's parts, one after the other (DeVRF, Tables 2 and 3)."""

from dataclasses import replace

from devrf.reconstruct.options import MotionOptions, resized_motion

VARIANTS = ("base", "c2f", "tv", "cycle", "flow")  # each adds one part to the one before it


def ablated(options: MotionOptions, published: MotionOptions) -> dict[str, MotionOptions]:
    """Options of every variant, by name: of motion fields, with the published pyramid, whatever the preset.

    `base` trains one level at the full resolution for as many iterations as the pyramid has in all; `c2f` is the
    pyramid with the re-rendering loss (and what the published program adds to it) alone. Then total variation,
    cycle consistency and flow come back, one after the other; `flow` is everything. None is fine-tuned: that would
    make up for motion that is wrong. None follows movers: those have none of these parts.

    Args:
        options: What all variants have in common, but the pyramid.
        published: Of preset `reference`; its levels are brought to the resolution of `options`.
    """
    pyramid = resized_motion(published, options.resolution / published.resolution)
    options = replace(
        options, levels=pyramid.levels, iterations=pyramid.iterations, fine_tuning=0, together=0
    )
    c2f = replace(options, variation=0.0, cycle=0.0, flow=0.0)
    return {
        "base": replace(c2f, levels=options.levels[-1:], iterations=(sum(options.iterations),)),
        "c2f": c2f,
        "tv": replace(c2f, variation=options.variation),
        "cycle": replace(options, flow=0.0),
        "flow": options,
    }
