"""The top of the report: one verdict with its remedies, the key numbers, the film, and the stages."""

from collections.abc import Mapping
from typing import Any

from devrf.pipelines.report.html import duration, link, number, readable, table, text
from devrf.pipelines.report.pictures import data_uri, picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder, at

METRICS, HEALTH = "evaluate/metrics.json", "health.json"
POSTER_WIDTH = 800
MAX_FILM_BYTES = 8_000_000  # base64 makes it a third larger; a bigger film is linked instead


def verdict(run: RunFolder) -> str:
    """One line from all health rows, and what to do about those that are not fine."""
    rows = [(stage, n, row) for stage in run.stages for n, row in enumerate(health_rows(run, stage))]
    bad = [found for found in rows if found[2].get("verdict") == "fail"]
    doubtful = [found for found in rows if found[2].get("verdict") == "warn"]
    missing = [s for s in run.stages if s not in ("report", *run.reasons, *run.errors) and not run.has(s)]
    if bad:
        kind, line = "fail", f"{len(bad)} of {len(rows)} checks failed: do not trust this result."
    elif run.errors:
        kind, line = "fail", f"Stopped: {', '.join(run.errors)} failed."
    elif doubtful:
        kind, line = "warn", f"{len(doubtful)} of {len(rows)} checks warn; the others passed."
    elif rows:
        kind, line = "ok", f"All {len(rows)} checks passed."
    else:
        kind, line = "warn", "No stage has checked its result yet."
    notes = "".join(
        f"<li><strong>{text(s)}</strong> failed: {text(e.removeprefix(f'{s}: '))}</li>"
        for s, e in run.errors.items()
    )
    notes += "".join(_remedy(*found) for found in [*bad, *doubtful])
    if missing:
        have = "has" if len(missing) == 1 else "have"
        notes += f"<li>Not finished: {text(', '.join(missing))} {have} not run.</li>"
        kind = "warn" if kind == "ok" else kind
    if run.stale:
        (first, why), *_ = run.stale.items()
        notes += (
            f"<li>Stale: {text(', '.join(run.stale))}. What they were made from has changed since ({text(first)}: "
            f"{text(why)}); run the scene again.</li>"
        )
        kind = "warn" if kind == "ok" else kind
    notes += "".join(
        f"<li><code>{text(f)}</code> cannot be read: {text(e)}</li>" for f, e in run.unreadable.items()
    )
    notes = f"<ul>{notes}</ul>" if notes else ""
    return f'<div class="verdict {kind}"><strong>{text(line)}</strong>{notes}</div>'


def tiles(run: RunFolder) -> str:
    """The numbers a reader looks for first."""
    metrics = run.object(METRICS)
    if not metrics:
        return f'<p class="absent">No key numbers. {text(run.why_absent("evaluate"))}</p>'

    def of(key: str, unit: str, digits: int) -> str:
        block, _, name = key.rpartition(".")
        why = at(metrics, f"{block}.why.{name}") or ""
        return number(at(metrics, key), unit, digits, file=METRICS, key=key, why=str(why))

    out = []
    if at(metrics, "test_moving.psnr") is not None:
        still = of("static_baseline.test_moving.psnr", "dB", 1)
        more = f"as if nothing moved: {still}; where the true picture differs from the scene at rest"
        out.append(("PSNR where it moves", of("test_moving.psnr", "dB", 1), more))
    if metrics.get("test") != metrics.get("test_static"):
        out.append(("PSNR, test views", of("test.psnr", "dB", 1), f"SSIM {of('test.ssim', '', 3)}"))
    if metrics.get("test_static") is not None:
        more = f"SSIM {of('test_static.ssim', '', 3)}"
        out.append(("PSNR, held-out sweep", of("test_static.psnr", "dB", 1), more))
    more = text(f"on {at(metrics, 'train.device')}") if at(metrics, "train.device") else ""
    out.append(("Training", of("train.total_s", "s", 0), more))
    out.append(("Model", of("model_mb", "MB", 1), ""))
    out.append(("Rendering", of("render_fps", "fps", 2), ""))
    cells = "".join(
        f'<div class="tile"><div class="name">{text(name)}</div><div class="value">{value}</div>'
        f'<div class="more">{more}</div></div>'
        for name, value, more in out
    )
    return f'<div class="tiles">{cells}</div>'


def film(run: RunFolder) -> str:
    """The rendered film: inside the page where it is small enough, else linked."""
    films = sorted((run.path / "render").glob("*.mp4")) if run.has("render") else []
    if not films:
        return f'<p class="absent">No film. {text(run.why_absent("render"))}</p>'
    file = f"render/{films[0].name}"
    small = run.film_inside and films[0].stat().st_size <= MAX_FILM_BYTES
    source = data_uri(films[0].read_bytes(), "video/mp4") if small else f"../{file}"
    still = read_picture(run.path / "render" / "poster.png")
    uri = picture_uri(still, POSTER_WIDTH) if still is not None else ""
    poster = f' poster="{uri}"' if uri else ""
    on_paper = f'<img class="paper" src="{uri}" alt="A picture of the film">' if uri else ""
    others = "".join(f", {link(f'render/{other.name}')}" for other in films[1:])
    return (
        '<figure class="film"><video controls muted loop playsinline preload="metadata" '
        f'aria-label="Rendered film"{poster} src="{text(source)}"></video>{on_paper}'
        f"<figcaption>Rendered film: {link(file)}{others}</figcaption></figure>"
    )


def stages_table(run: RunFolder) -> str:
    """Which stages ran, how long they took, what they found."""
    rows = []
    for stage in run.stages:
        if stage == "report":
            continue
        if stage in run.reasons:
            state = f'<span class="none">does not apply: {text(run.reasons[stage])}</span>'
        else:
            state = (
                _done(run, stage) if run.has(stage) else f'<span class="none">{_not_there(run, stage)}</span>'
            )
        seconds = run.object(f"{stage}/stamp.json").get("seconds")
        took = (
            f'<a class="n" href="../{stage}/stamp.json" title="{readable(float(seconds), 1)} s">'
            f"{text(duration(float(seconds)))}</a>"
            if isinstance(seconds, (int, float))
            else ""
        )
        rows.append([f"<strong>{text(stage)}</strong>", state, took, _chips(run, stage), making(run, stage)])
    checks = [
        [
            link(f"{stage}/{HEALTH}", stage),
            text(row.get("check", "")),
            _health_value(stage, n, row),
            _bound(row.get("warn"), row.get("unit")),
            _bound(row.get("fail"), row.get("unit")),
            f'<span class="chip {text(row.get("verdict", ""))}">{text(row.get("verdict", ""))}</span>',
        ]
        for stage in run.stages
        for n, row in enumerate(health_rows(run, stage))
    ]
    details = (
        f"<details><summary>All {len(checks)} checks</summary>"
        + table(("stage", "check", "value", "warns at", "fails at", "verdict"), checks, numeric=(2, 3, 4))
        + "</details>"
        if checks
        else ""
    )
    head = ("stage", "state", "time", "checks", "made")
    return f'<h2 class="small">Stages</h2>{table(head, rows, numeric=(2,), wide_last=True)}{details}'


def health_rows(run: RunFolder, stage: str) -> list[dict[str, Any]]:
    """The rows a stage wrote about its own result."""
    value = run.json(f"{stage}/{HEALTH}")
    rows = value.get("rows") if isinstance(value, Mapping) else value
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def _done(run: RunFolder, stage: str) -> str:
    why = run.stale.get(stage)
    return "done" if why is None else f'<span class="chip warn" title="{text(why)}">stale</span>'


def _not_there(run: RunFolder, stage: str) -> str:
    return '<span class="chip fail">failed</span>' if stage in run.errors else "has not run"


def _remedy(stage: str, n: int, row: dict[str, Any]) -> str:
    found = f"{text(row.get('check', ''))}: {_health_value(stage, n, row)}"
    return f"<li>{link(f'{stage}/{HEALTH}', stage)}: {found}. {text(row.get('remedy', ''))}</li>"


def _health_value(stage: str, n: int, row: dict[str, Any]) -> str:
    value = row.get("value")
    if isinstance(value, str):
        return text(value)
    unit, digits = str(row.get("unit") or ""), _decimals(value, 3)
    return number(value, unit, digits, file=f"{stage}/{HEALTH}", key=f"rows.{n}.value")


def _bound(value: object, unit: object) -> str:
    if not isinstance(value, (int, float)):
        return ""
    return f"{readable(float(value), _decimals(value, 2))} {text(unit)}"


def _decimals(value: object, most: int) -> int:
    """No decimals for whole numbers: counts stand among measures in the health rows."""
    return 0 if isinstance(value, (int, float)) and float(value).is_integer() else most


def _chips(run: RunFolder, stage: str) -> str:
    found = [row.get("verdict") for row in health_rows(run, stage)]
    return " ".join(
        f'<span class="chip {kind}">{found.count(kind)} {word}</span>'
        for kind, word in (("ok", "ok"), ("warn", "warn"), ("fail", "failed"))
        if found.count(kind)
    )


def making(run: RunFolder, stage: str) -> str:
    """One making of a stage, linked to its stamp; empty text where there is none."""
    file = f"{stage}/stamp.json"
    stamp = run.object(file)
    if not stamp:
        return ""
    made = [f"made {stamp['finished']}"] if stamp.get("finished") else []
    made += [f"in run {stamp['run']}"] if stamp.get("run") else []
    said = f" {text(' '.join(made))}" if made else ""
    return f'<span title="id {text(stamp.get("id"))}">{link(file, stage)}{said}</span>'
