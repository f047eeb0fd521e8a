"""The only thing pyproject.toml cannot say: six top-level folders, and the example, install as devrf.*."""

from setuptools import find_packages, setup

DOMAINS = ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab")
INSIDE = [f"devrf.{d}.{p}" for d in DOMAINS for p in find_packages(d)]
EXAMPLE = "devrf.example"  # for `devrf-pipeline demo`; files, and no code

setup(
    packages=["devrf", "devrf.api", EXAMPLE, *(f"devrf.{d}" for d in DOMAINS), *INSIDE],
    package_dir={
        "devrf": "src/devrf",
        EXAMPLE: "examples/workshop",
        **{f"devrf.{d}": d for d in DOMAINS},
    },
)
