"""The cases of golden.yaml: what each needs in its folder, and the commands that are run there."""

import copy
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import yaml

REPOSITORY = Path(__file__).resolve().parent.parent
EXAMPLE = REPOSITORY / "examples" / "workshop"
TABLE = yaml.safe_load(Path(__file__).with_name("golden.yaml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Case:
    """One thing that is run; texts hold the places that golden.yaml names.

    Attributes:
        name: Of it and of its folder.
        commands: Arguments of `devrf-pipeline`, by name.
        again, again_runs: The command that repeats it with another seed, and what it leaves (where this is no
            pattern, first a copy of `runs`); None: it is not repeated.
        runs: Run folders whose results are compared: a pattern below the case's folder.
        copied: Folder whose files are copied into the case's.
        pictures: A film, and how many of its pictures make one that is written into `pictures`.
        scene: Of scene.yaml, beside its name and output, tiny where it names no preset.
        exported, formats: The case that is exported, and options by format.
        first_severities: Whether the first severity of each axis is taken (`bench stability` offers the worst).
        subset: Whether it belongs to the part that is run after every commit.
    """

    name: str
    commands: Mapping[str, str] = field(default_factory=dict)
    again: str | None = None
    again_runs: str = "seed{seed}"
    runs: str = "run"
    copied: str | None = None
    pictures: tuple[str, int] | None = None
    scene: Mapping[str, Any] | None = None
    exported: str | None = None
    formats: Mapping[str, str] = field(default_factory=dict)
    first_severities: bool = False
    subset: bool = False

    @property
    def in_process(self) -> bool:
        """Whether many short commands run in one process."""
        return self.name == "broken" or self.exported is not None

    def prepare(self, folder: Path, data: Path) -> None:
        """Write what its commands need into its folder, from the example and the captures in `data`."""
        places = {"data": data, "example": EXAMPLE, "sheet": REPOSITORY / "tests" / "sheet"}
        if self.copied:
            source = Path(self.copied.format(**places))
            scene = yaml.safe_load((source / "scene.yaml").read_text(encoding="utf-8"))
            for file in (file for file in source.iterdir() if file.is_file()):
                shutil.copy(file, folder)
            _write(folder / "scene.yaml", scene | {"output": "run"})
        if self.pictures:
            _write_pictures(self.pictures[0].format(**places), folder / "pictures", self.pictures[1])
        if self.scene:
            scene = {"name": self.name, "preset": "tiny", **self.scene, "output": "run"}
            _write(folder / "scene.yaml", _filled(scene, places))
        if self.name == "broken":
            (folder / "empty.mp4").touch()
            for name, text in broken_scenes().items():
                (folder / f"{name}.yaml").write_text(text, encoding="utf-8")


def cases() -> list[Case]:
    """All of them, in the order in which they are run."""
    found = {name: Case(name, **values) for name, values in TABLE["cases"].items()}
    for name, case in found.items():
        commands = dict(case.commands)
        if name == "broken":
            commands = {each: f"run {{case}}/{each}.yaml --dry-run" for each in broken_scenes()}
        for each, options in case.formats.items():
            export = f"export {{work}}/{case.exported}/scene.yaml --out {{case}}/{each}"
            commands[each] = f"{export} --format {each} {options}"
        found[name] = replace(case, commands=commands)
    return list(found.values())


def broken_scenes() -> dict[str, str]:
    """Texts of scene.yaml by what is wrong with them, as a file's name."""
    table = TABLE["broken"]
    texts = {name: _dumped(_changed(table["whole"], change)) for name, change in table["changes"].items()}
    whole = texts["nothing wrong"]
    texts |= {name: whole.replace(old, new) for name, (old, new) in table["texts"].items()}
    return {name.replace(" ", "-").replace(",", ""): text for name, text in texts.items()}


def _changed(whole: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    scene = copy.deepcopy(whole)
    for key, value in changes.items():
        *sections, last = key.split(".")
        inner: Any = scene
        for section in sections:
            inner = inner[section]
        inner[int(last) if last.isdigit() else last] = value
        if value == "GONE":
            del inner[last]
    return scene


def _filled(tree: Any, places: Mapping[str, Path]) -> Any:
    """With folders in place of their names."""
    if isinstance(tree, dict):
        return {key: _filled(value, places) for key, value in tree.items()}
    return tree.format(**places) if isinstance(tree, str) else tree


def _write_pictures(film: str, folder: Path, every: int) -> None:
    folder.mkdir(exist_ok=True)
    clip, index = cv2.VideoCapture(film), 0
    while (picture := clip.read()[1]) is not None:
        if index % every == 0:
            cv2.imwrite(str(folder / f"{index:03d}.png"), picture)
        index += 1


def _dumped(scene: Mapping[str, Any]) -> str:
    return yaml.safe_dump(scene, sort_keys=False)


def _write(path: Path, scene: Mapping[str, Any]) -> None:
    path.write_text(_dumped(scene), encoding="utf-8")
