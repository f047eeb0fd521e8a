"""The declarative runner: scene.yaml, stages, health, report, command line."""

if __name__ != "devrf.pipelines":
    raise ImportError("import devrf.pipelines, not pipelines")
