"""One call of `devrf-pipeline run`: which stages run, and why, and whether that can be done.

The one place that compares stamps, for `run`, `--dry-run`, `status` and batches.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.system.errors import InputError
from devrf.pipelines.run_folder.outcomes import is_to_be_forced, last_error, read_health
from devrf.pipelines.runner.standing import Choice, Standing
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.digests import Digests
from devrf.pipelines.stamps.reasons import why_stale
from devrf.pipelines.stamps.stamp import identity, read_stamp
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.logs import new_run_name

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
        """Where every stage stands, what must run before it considered.

        A stage that the choice leaves out does not make others stale.
        """
        will_run: list[str] = []
        found = []
        for stage in self.stages:
            now = self.standing(stage, will_run)
            if now.to_make and self.chosen(stage.name):
                will_run.append(stage.name)
            found.append(now)
        return found

    def standing(self, stage: Stage, will_run: Sequence[str] = (), *, whole: bool = False) -> Standing:
        """Compare one stage with what would make it now; one that the choice forces is stale until it is made.

        Args:
            stage: The stage.
            will_run: Stages known to run before it; what reads them is stale, unless they come out the same.
            whole: Whether its files are known to be as they were left: it has only just been made.
        """
        reason = stage.applies(self.config)
        if reason is not None:
            return Standing(stage, "not applicable", (reason,))
        reads, folder = self.reads_of(stage), self.run_dir / stage.name
        made_from = identity(stage, self.config, self.scene_dir, self.run_dir, reads, self.digests)
        stamp = read_stamp(folder)
        unknown = [name for name in reads if name in will_run]
        if stamp is None:
            state, why = "missing", ["not made yet"]
        else:
            then = stamp["identity"].get("reads")
            then = then if isinstance(then, dict) else {}
            known = {n: then.get(n) if n in unknown else made for n, made in made_from["reads"].items()}
            why = why_stale(
                stage, folder, stamp, made_from | {"reads": known}, None if whole else self.digests
            )
            why += [f"{name} runs" for name in unknown]
            again = is_to_be_forced(self.run_dir, stage.name, stamp)
            why += ["forced before, and not finished"] if again else []
            why += ["forced"] if not (why or whole) and self.forced(stage.name) else []
            state = "stale" if why else "fresh"
        return Standing(
            stage,
            state,
            tuple(why),
            None if stamp is None else stamp.get("seconds"),
            read_health(folder),
            last_error(self.run_dir, stage.name),
            None if unknown else made_from,
        )

    @property
    def applying(self) -> list[Stage]:
        """The stages that apply to the scene."""
        return [stage for stage in self.stages if stage.applies(self.config) is None]

    def reads_of(self, stage: Stage) -> list[str]:
        """The stages that one reads, without those that do not apply."""
        applying = {other.name for other in self.applying}
        return [name for name in stage.reads if name in applying]

    def chosen(self, name: str) -> bool:
        """Whether a stage lies between --from and --until."""
        names = [stage.name for stage in self.stages]
        first, last = self.choice.first or names[0], self.choice.last or names[-1]
        return names.index(first) <= names.index(name) <= names.index(last)

    def forced(self, name: str) -> bool:
        """Whether a stage runs even where nothing changed."""
        return name in self.choice.force or "all" in self.choice.force


def check_choice(run: Run) -> None:
    """Refuse stage names that do not exist and ranges that make no sense.

    Raises:
        InputError: With every mistake.
    """
    config, stages, choice = run.config, run.stages, run.choice
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
                if name in names and not run.chosen(name)
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
    unmade = [stage.name for stage in run.applying if not (run.run_dir / stage.name).is_dir()]
    chosen = [stage for stage in run.applying if run.chosen(stage.name)]
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
        if not run.chosen(name):
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
