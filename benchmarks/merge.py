"""One table of all scenes that benchmarks/gpu.sh has measured: reference-*.json -> reference.md, with the means."""

import json
import sys
from pathlib import Path

COLUMNS = {
    "reference/test/psnr": "PSNR, dB",
    "reference/test/ssim": "SSIM",
    "reference/test/lpips_vgg": "LPIPS (VGG)",
    "reference/canonical/seconds": "at rest, s",
    "reference/seconds": "motion, s",
    "reference/peak_gpu_gb": "GPU memory, GB",
    "reference/render_fps": "pictures/s",
    "ablation/base/test/psnr": "base",
    "ablation/c2f/test/psnr": "c2f",
    "ablation/tv/test/psnr": "+tv",
    "ablation/cycle/test/psnr": "+cycle",
    "ablation/flow/test/psnr": "+flow",
}


def table(folder: Path) -> str:
    """Markdown; the last five columns are the ablation's PSNR at half size."""
    results = [json.loads(path.read_text()) for path in sorted(folder.glob("reference-*.json"))]
    lines = ["| scene | device | " + " | ".join(COLUMNS.values()) + " |", "|---" * (2 + len(COLUMNS)) + "|"]
    columns: list[list[float | None]] = []
    for result in results:
        values = {row["name"]: row["value"] for row in result["rows"]}
        columns.append([values.get(name) for name in COLUMNS])
        lines.append(_line(result["scene"], result["device"], columns[-1]))
    if len(results) > 1 and len({r["device"] for r in results}) == 1:
        means = [_mean([row[n] for row in columns]) for n in range(len(COLUMNS))]
        lines.append(_line("mean", results[0]["device"], means))
    return "\n".join(lines) + "\n"


def _line(scene: str, device: str, values: list[float | None]) -> str:
    cells = ["not measured" if v is None else f"{v:.4g}" for v in values]
    return f"| {scene} | {device} | " + " | ".join(cells) + " |"


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


if __name__ == "__main__":
    target = Path(sys.argv[1])
    (target / "reference.md").write_text(table(target))
    print(table(target), end="")
