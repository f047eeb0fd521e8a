"""The paper's ablation: the motion's parts, one after the other (DeVRF, Tables 2 and 3)."""

from dataclasses import replace

from devrf.reconstruct.options import MotionOptions

VARIANTS = ("base", "c2f", "tv", "cycle", "flow")  # each adds one part to the one before it


def ablated(options: MotionOptions) -> dict[str, MotionOptions]:
    """Options of every variant, by name.

    `base` trains one level at the full resolution for as many iterations as the pyramid has in all; `c2f` is the
    pyramid with the re-rendering loss (and what the published program adds to it) alone. Then total variation,
    cycle consistency and flow come back, one after the other; `flow` is everything. None is fine-tuned: that would
    make up for motion that is wrong.
    """
    options = replace(options, fine_tuning=0)
    c2f = replace(options, variation=0.0, cycle=0.0, flow=0.0)
    return {
        "base": replace(c2f, levels=options.levels[-1:], iterations=(sum(options.iterations),)),
        "c2f": c2f,
        "tv": replace(c2f, variation=options.variation),
        "cycle": replace(options, flow=0.0),
        "flow": options,
    }
