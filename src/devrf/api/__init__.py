"""The Python API: what `import devrf` gives (docs/api.md). It stands above all rooms, and no room imports it."""
