"""docs/configuration.md, from the models of scene.yaml: every key with what it takes, its default and its meaning."""

import ast
import inspect
import re
from collections.abc import Iterator
from functools import cache
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from devrf.pipelines.config import scene as models
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.config.words import expectation
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stages.scene import MAX_PIXELS
from devrf.reconstruct.options import PRESETS

UNITS = {"m": "metres", "s": "seconds", "minutes": "minutes", "gb": "10⁹ bytes"}  # by the end of a key's name
READ_AS_INPUTS = {"evaluate.truth": ("evaluate",)}  # by `Stage.inputs`, named or not
MORE = {  # key or section -> page that says more
    "capture.timestamps": "formats.md#timestamps-table",
    "capture.board": "field.md#init",
    "capture.raw": "ingest.md",
    "capture.white": "colour.md",
    "capture.mattes": "mattes.md",
    "dataset": "formats.md#data-sets",
    "calibration.rig.given": "formats.md#calibrations-of-other-tools",
    "calibration.colour": "colour.md",
    "flow": "flow.md",
    "reconstruct": "reference.md",
    "reconstruct.adapt": "reference.md#no-more-than-a-scene-needs",
    "budget": "budgets.md",
    "cache": "formats.md#the-cache",
    "evaluate.lpips_weights": "formats.md#lpips-weights",
    "evaluate.truth": "formats.md#ground_truthjson",
}
HEAD = """# Configuration

<!-- Written by `python -m devrf.pipelines.manual`; what it says stands in pipelines/config/scene.py. -->

Every key of `scene.yaml`. Paths are relative to the file. Unknown keys, wrong types and values out of range are
errors, all reported at once before anything starts. `--set a.b=value` overrides any key for one call.

- **default**: – where there is none; the meaning says what is then done. Three values are those of the presets
  `tiny` · `fast` · `reference`.
- **stages**: those that are run anew when the key changes, and whatever reads a result that came out otherwise.
  – where no result depends on it.
- Either `capture` or `dataset` is needed. A capture with only `static` is a scene at rest; one with only `cameras`
  can be run `--until flow`.
- Paths: at most 1000 characters, a name in them 255 bytes; `scene.yaml` itself at most 250 kB and 20 000 values. How
  large other files may be: [security.md](security.md).
"""


def page() -> str:
    """The page, as Markdown."""
    return "\n".join([HEAD, *_tables("", SceneConfig)])


def _tables(section: str, model: type[BaseModel]) -> Iterator[str]:
    """Heading and table of a section, then those of the sections in it."""
    yield f"## `{section or 'scene.yaml'}`\n"
    yield f"{(model.__doc__ or '').strip()}{_more(section)}\n"
    yield "| key | takes | default | meaning | stages |\n|---|---|---|---|---|"
    inner = []
    for name, field in model.model_fields.items():
        key = f"{section}.{name}".lstrip(".")
        below = _section(field)
        if below is not None:
            inner.append((key, below))
        takes = f"[section](#{key.replace('.', '')})" if below is not None else _takes(key, field)
        meaning = _meanings(model)[name] + _more(key)
        cells = (f"`{key}`", takes, _default(key, field), meaning, _stages(key))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
    yield ""
    for key, below in inner:
        yield from _tables(key, below)


def _section(field: FieldInfo) -> type[BaseModel] | None:
    kinds = (field.annotation, *get_args(field.annotation))
    plain = [get_args(kind)[0] if hasattr(kind, "__metadata__") else kind for kind in kinds]
    return next((kind for kind in plain if isinstance(kind, type) and issubclass(kind, BaseModel)), None)


def _takes(key: str, field: FieldInfo) -> str:
    unit = UNITS.get(key.rpartition("_")[2]) if "_" in key.rpartition(".")[2] else None
    words = re.sub(r"(\{.*?\})", r"`\1`", expectation(field))
    return words + (f", {unit}" if unit else "")


def _default(key: str, field: FieldInfo) -> str:
    if field.is_required():
        return "(needed)"
    by_preset = _presets().get(key)
    if by_preset is not None:
        return " · ".join(by_preset)
    if field.default is None or _section(field) is not None:
        return "–"
    value = field.default
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


@cache
def _presets() -> dict[str, list[str]]:
    """Key -> what the presets have where it is not given, in their order."""
    found: dict[str, list[str]] = {}
    for name, options in PRESETS.items():
        rest, motion = options.canonical, options.motion
        values = {
            "image_scale": "1"
            if MAX_PIXELS[name] >= 10**9
            else f"at most {MAX_PIXELS[name]:,} pixels a picture".replace(",", " "),
            "resolution": f"`{rest.resolution}`",
            "rays": f"`{rest.rays}`, motion `{motion.rays}`",
            "canonical_iterations": f"`{rest.iterations}`",
            "motion_iterations": f"`{sum(motion.iterations)}`",
            "fine_tuning_iterations": f"`{motion.fine_tuning}`",
            "key_times": f"at most {motion.most_keys}",
            "adapt": f"`{str(motion.adapt).lower()}`",
        }
        for key, value in values.items():
            found.setdefault(f"reconstruct.{key}", []).append(value)
    return found


def _stages(key: str) -> str:
    """Stages whose stamp holds the key, a section around it, or a key in it."""
    found = [
        stage.name
        for stage in STAGES
        if any(f"{key}.".startswith(f"{own}.") or own.startswith(f"{key}.") for own in stage.config_keys)
        or stage.name in READ_AS_INPUTS.get(key, ())
    ]
    return ", ".join(found) or "–"


def _more(key: str) -> str:
    return f" ([more]({MORE[key]}))" if key in MORE else ""


@cache
def _meanings(model: type[BaseModel]) -> dict[str, str]:
    """Field -> the text below it in the source."""
    (of_class,) = (
        node
        for node in ast.parse(inspect.getsource(models)).body
        if isinstance(node, ast.ClassDef) and node.name == model.__name__
    )
    return {
        field.target.id: " ".join(text.value.value.split()).replace("->", "→")
        for field, text in zip(of_class.body, of_class.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }
