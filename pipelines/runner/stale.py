"""Stages of a run that are made and would be made again: which, why, and what is said of them."""

from collections.abc import Mapping

from devrf.pipelines.runner.run_state import Run


def stale_stages(job: Run, until: str) -> dict[str, str]:
    """Stages up to `until` that are made, and that a run would make again: why, by name, in the order of the stages."""
    names = [stage.name for stage in job.stages]
    up_to = names[: names.index(until) + 1]
    found = {now.stage.name: "; ".join(now.why) for now in job.standings() if now.state == "stale"}
    job.digests.save()
    return {name: why for name, why in found.items() if name in up_to}


def said_of_stale(stages: Mapping[str, str]) -> list[str]:
    """One line about stages that are stale; none where none is."""
    if not stages:
        return []
    (first, why), *more = stages.items()
    others = f", and so are {', '.join(name for name, _ in more)}" if more else ""
    return [f"the run is stale, and taken as it is: {first} ({why}){others}; run the scene again to renew it"]
