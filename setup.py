"""The only thing pyproject.toml cannot say: five top-level folders install as devrf.*."""

from setuptools import find_packages, setup

DOMAINS = ("capture", "calibration", "flow", "reconstruct", "pipelines")
INSIDE = [f"devrf.{d}.{p}" for d in DOMAINS for p in find_packages(d)]

setup(
    packages=["devrf", *(f"devrf.{d}" for d in DOMAINS), *INSIDE],
    package_dir={"devrf": "src/devrf", **{f"devrf.{d}": d for d in DOMAINS}},
)
