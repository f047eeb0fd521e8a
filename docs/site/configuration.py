"""docs/configuration.md and the JSON schema, from that of scene.yaml: `python docs/site/configuration.py [FILE]`.

The page ends with the options of `simulate`, which are strict models too.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydantic

PAGE = Path(__file__).resolve().parents[1] / "configuration.md"
SCHEMA = PAGE.parents[1] / "pipelines" / "config" / "scene.schema.json"
DRAFT = "https://json-schema.org/draft/2020-12/schema"
MORE = {  # key or section -> page that says more
    "capture.timestamps": "formats.md#timestamps-table",
    "capture.board": "field.md#init",
    "capture.raw": "ingest.md",
    "capture.mattes": "mattes.md",
    "dataset": "formats.md#data-sets",
    "calibration.rig.given": "formats.md#calibrations-of-other-tools",
    "calibration.colour": "colour.md",
    "flow": "flow.md",
    "reconstruct": "reference.md",
    "reconstruct.adapt": "reference.md#no-more-than-a-scene-needs",
    "budget": "budgets.md",
    "evaluate.lpips_weights": "formats.md#lpips-weights",
    "evaluate.truth": "formats.md#ground_truthjson",
}
WORDS = {"string": "text", "integer": "whole number", "number": "number", "boolean": "true or false"}
BOUNDS = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}
HEAD = """# Configuration

<!-- Written by `make pages`; what it says stands in pipelines/config/scene.py. -->

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


def main(page: Path, json_schema: Path) -> None:
    """Write the page, and the schema for editors."""
    pydantic.BaseModel.model_config["use_attribute_docstrings"] = True  # before the models are made
    from devrf.pipelines.config.scene import SceneConfig

    schema = SceneConfig.model_json_schema()
    whole = {
        "$schema": DRAFT,
        "title": "scene.yaml of devrf",
        **{k: v for k, v in schema.items() if k != "title"},
    }
    json_schema.write_text(json.dumps(whole, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    lines = [HEAD, *tables("", schema, schema["$defs"]), *options_of_simulate()]
    page.write_text("\n".join(lines), encoding="utf-8")


def tables(section: str, schema: dict[str, Any], definitions: dict[str, Any]) -> Iterator[str]:
    """Heading and table of a section, then those of the sections in it."""
    yield f"## `{section or 'scene.yaml'}`\n"
    yield f"{schema['description']}{more(section)}\n"
    yield "| key | takes | default | meaning | stages |\n|---|---|---|---|---|"
    inner = {}
    for name, field in schema["properties"].items():
        key = f"{section}.{name}".lstrip(".")
        below = [kind["$ref"].split("/")[-1] for kind in kinds(field) if "$ref" in kind]
        takes = " or ".join(map(words, kinds(field)))
        if below:
            inner[key], takes = definitions[below[0]], f"[section](#{key.replace('.', '')})"
        default = "(needed)" if name in schema.get("required", ()) else default_of(key, field, bool(below))
        meaning = field.get("description") or inner[key]["description"]  # said once where both are the same
        meaning = " ".join(meaning.split()).replace("->", "→") + more(key)
        cells = (f"`{key}`", takes, default, meaning, stages(key))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
    yield ""
    for key, model in inner.items():
        yield from tables(key, model, definitions)


def options_of_simulate() -> Iterator[str]:
    """Heading and a table for each protocol of `simulate`."""
    from devrf.lab.simulate.scenes.objects import OBJECTS
    from devrf.lab.simulate_command import PROTOCOLS

    yield "## Options of simulate\n"
    yield "Each option is set with `--set name=value`; which ones there are depends on `--protocol`.\n"
    for protocol, made in PROTOCOLS.items():
        yield f"### `{protocol}`\n\n| option | takes | default | meaning |\n|---|---|---|---|"
        for option, field in made.options.model_json_schema()["properties"].items():
            meaning = " ".join(field["description"].split())
            cells = (f"`{option}`", words(field), default_of(option, field, False), meaning)
            yield "| " + " | ".join(cells) + " |"
        yield ""
        for scene, kind in OBJECTS.items() if protocol == "session" else ():
            if kind.usual:
                yield f"`--scene {scene}` begins with `{' '.join(kind.usual)}`, and with pictures of {kind.size}.\n"


def kinds(field: dict[str, Any]) -> list[dict[str, Any]]:
    """What a field may be, but for nothing."""
    return [kind for kind in field.get("anyOf", [field]) if kind.get("type") != "null"]


def words(kind: dict[str, Any]) -> str:
    """What a value is: `whole number from 64 to 1048576`."""
    if "enum" in kind or "const" in kind:
        return ", ".join(map(str, kind.get("enum", [kind.get("const")])))
    if kind.get("type") == "array":
        items = kind.get("prefixItems", ())
        return f"list of {len(items)} × {words(items[0])}" if "prefixItems" in kind else "list of texts"
    if kind.get("type") == "object":
        return f"`{{NAME: …}}`, for each a {words(kind['additionalProperties'])}"
    bounds = [f"{word} {kind[bound]}" for bound, word in BOUNDS.items() if bound in kind]
    word = kind.get("format") or WORDS.get(kind.get("type", ""), "section")
    return " ".join([word, *bounds])


def default_of(key: str, field: dict[str, Any], is_section: bool) -> str:
    """What it is where it is not given."""
    if key in presets():
        return " · ".join(presets()[key])
    value = field.get("default")
    if value is None or is_section:
        return "–"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def presets() -> dict[str, list[str]]:
    """Key -> what the presets have where it is not given, in their order."""
    from devrf.pipelines.stages.scene.scene_stage import MAX_PIXELS
    from devrf.reconstruct.options import PRESETS

    found: dict[str, list[str]] = {}
    for name, options in PRESETS.items():
        rest, motion, most = options.canonical, options.motion, MAX_PIXELS[name]
        values = {
            "image_scale": "`1`" if most >= 10**9 else f"at most {most} pixels a picture",
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


def stages(key: str) -> str:
    """Stages whose stamp holds the key, a section around it, or a key in it; `evaluate` reads the truth as a file."""
    from devrf.pipelines.stages import STAGES

    found = [
        stage.name
        for stage in STAGES
        if any(f"{key}.".startswith(f"{own}.") or own.startswith(f"{key}.") for own in stage.config_keys)
        or (stage.name, key) == ("evaluate", "evaluate.truth")
    ]
    return ", ".join(found) or "–"


def more(key: str) -> str:
    """A link to the page that says more."""
    return f" ([more]({MORE[key]}))" if key in MORE else ""


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]), Path(sys.argv[1]).with_name(SCHEMA.name))
    else:
        main(PAGE, SCHEMA)
