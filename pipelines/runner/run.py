"""One call of `devrf-pipeline run`: what was asked for, whether it can be done, and what it would do."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.errors import InputError
from devrf.pipelines.console import Talk
from devrf.pipelines.logs import new_run_name
from devrf.pipelines.runner.plan import Choice, Standing, is_chosen, standing, standings
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.digests import Digests

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

NEEDS_SWEEP = "canonical"  # the first stage that cannot do without a sweep


@dataclass
class Run:
    """One call of `devrf-pipeline run`.

    Attributes:
        config: The checked configuration.
        scene_dir: Folder of scene.yaml.
        stages: The pipeline.
        choice: Which stages to run.
        talk: Where to speak.
        device: "cpu" or "cuda".
        name: Its name in logs, events and stamps.
        executed: The stages that were made.
        fresh: Those, and the ones that were skipped because nothing they depend on has changed.
    """

    config: "SceneConfig"
    scene_dir: Path
    stages: Sequence[Stage]
    choice: Choice
    talk: Talk
    device: str = "cpu"
    name: str = field(default_factory=new_run_name)
    executed: list[str] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)

    @property
    def run_dir(self) -> Path:
        """The run folder."""
        return self.config.run_dir(self.scene_dir)

    @cached_property
    def digests(self) -> Digests:
        """Content digests, remembered from one look at the files to the next."""
        return Digests(self.run_dir)

    def standings(self) -> list[Standing]:
        """Where every stage stands."""
        return standings(self.stages, self.config, self.scene_dir, self.run_dir, self.choice, self.digests)

    def standing(self, stage: Stage, *, whole: bool = False) -> Standing:
        """Where one stage stands, those before it as they are, its files unread where they are known to be `whole`."""
        return standing(
            stage,
            self.stages,
            self.config,
            self.scene_dir,
            self.run_dir,
            self.digests,
            whole=whole,
        )


def check_choice(config: "SceneConfig", stages: Sequence[Stage], choice: Choice) -> None:
    """Refuse stage names that do not exist and ranges that make no sense.

    Raises:
        InputError: With every mistake.
    """
    names = [stage.name for stage in stages]
    mistakes = []
    options = [("--from", choice.first), ("--until", choice.last), *(("--force", s) for s in choice.force)]
    for option, name in options:
        if name is not None and name not in names and not (option == "--force" and name == "all"):
            mistakes.append(f"{option} {name}: no such stage; expected {', '.join(names)}")
    if not mistakes:
        if choice.first and choice.last and names.index(choice.first) > names.index(choice.last):
            mistakes.append(f"--from {choice.first} --until {choice.last}: the first comes after the last")
        for option, name in options:
            reason = next((s.applies(config) for s in stages if s.name == name), None)
            if reason and not (option == "--until" and config.kind != "cameras"):
                mistakes.append(f"{option} {name}: the stage does not apply: {reason}")
        if not mistakes:
            mistakes += [
                f"--force {name}: lies outside of --from and --until and would not run; leave it out, or widen them"
                for name in choice.force
                if name in names and not is_chosen(name, stages, choice)
            ]
        until = choice.last or names[-1]
        if config.kind == "cameras" and NEEDS_SWEEP in names and not mistakes:
            if names.index(until) >= names.index(NEEDS_SWEEP):
                mistakes.append(
                    "capture.static: is missing; without a sweep of the scene at rest there is nothing to "
                    "reconstruct from: add one, or run with --until flow"
                )
    if mistakes:
        raise InputError("stages-misnamed", "\n".join(mistakes))


def check_reads(run: Run, remedy: str | None = None) -> None:
    """Refuse to start at a stage that reads what neither is made nor will be.

    Raises:
        InputError: With the remedy; None advises to start at the first stage that is missing.
    """
    applying = [stage for stage in run.stages if stage.applies(run.config) is None]
    unmade = [stage.name for stage in applying if not (run.run_dir / stage.name).is_dir()]
    chosen = [stage for stage in applying if is_chosen(stage.name, run.stages, run.choice)]
    made = {stage.name for stage in chosen}
    for stage in chosen:
        missing = [name for name in stage.reads if name in unmade and name not in made]
        if missing:
            raise InputError(
                "stage-not-made",
                f"{stage.name} reads {', '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} "
                f"not made yet; {remedy or f'run without --from, or --from {unmade[0]}'}",
            )


def dry_run(run: Run, found: Sequence[Standing]) -> None:
    """Say what `execute` would do with stages that stand so, and touch nothing."""
    for now in found:
        name = now.stage.name
        if not is_chosen(name, run.stages, run.choice):
            run.talk.say(f"{name}: left alone (outside --from and --until)")
        elif now.state in ("fresh", "not applicable"):
            run.talk.say(skip_line(now))
        else:
            run.talk.say(f"{name}: would run: {'; '.join(now.why)}")


def skip_line(now: Standing) -> str:
    """What is said of a stage that does not run."""
    if now.state == "not applicable":
        return f"{now.stage.name}: does not apply: {now.why[0]}"
    return f"{now.stage.name}: skipped: nothing it depends on has changed"
