"""What the flow's own checks measure, for the stage's health."""

from collections.abc import Iterator, Mapping

from devrf.capture.measure import Measure, highest, lowest
from devrf.flow.checks import FlowChecks
from devrf.pipelines.health.judge import carried


def flow_measures(checks: Mapping[str, FlowChecks], given: bool = False) -> Iterator[Measure]:
    """The worst camera of each check (docs: capture, hand-off to training).

    Given flow need not be consistent with a way back that nobody knows; its mask may leave out the backdrop.
    """
    if checks and not given:  # of a plain backdrop nothing is known
        valid = {n: check.valid or 0.0 for n, check in checks.items()}
        name = min(valid, key=lambda n: valid[n])
        refuses = not carried("flow-consistent", valid.values())
        yield Measure("flow-consistent", checks[name].valid, name, refuses=refuses)
    moving = {name: check for name, check in checks.items() if check.moving_valid is not None}
    if moving:
        yield lowest("flow-moving", {name: check.moving_valid or 0.0 for name, check in moving.items()})
        ratio = {n: c.warp_ratio or 0.0 for n, c in moving.items()}
        yield highest("flow-warping", ratio, refuses=not carried("flow-warping", ratio.values()))
        for name, check in moving.items():
            if check.better_as is not None:
                whose = "in the data set's flow" if given else "in the method's result (flow.method)"
                facts = {"whose": whose}
                yield Measure("flow-meaning", RATHER[check.better_as], name, check.better_as, facts, "fail")
        far = {name: check.large or 0.0 for name, check in moving.items()}
        yield highest("flow-large", far, why="given" if given else "")
        if not given:
            yield highest("flow-unsure", {name: check.unsure or 0.0 for name, check in moving.items()})
    held = {name: check.shake_px for name, check in checks.items() if check.shake_px is not None}
    if held:
        yield highest("flow-shake", held)
    pairs = sum(check.gaps + check.pairs for check in checks.values())
    for name, check in checks.items():
        if check.gaps:
            lost = f"no flow across gaps in {name}"
            found = f"{check.gaps} gaps (of {pairs} pairs); no flow across them"
            yield Measure("frames-dropped", found, name, facts={"source": name, "lost": lost})


RATHER = {
    "forward": "the flow leads to the next frame, not to the one before",
    "next": "the flow of a frame is that of the frame after it",
    "before": "the flow of a frame is that of the frame before it",
    "full size": "vectors are in pixels of the full-size picture",
}
"""Other explanations of a flow (`FlowChecks.better_as`), in words."""
