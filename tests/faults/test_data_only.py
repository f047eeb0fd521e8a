"""The whole source, looked through for calls that would run what a file says, or open a port."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY

ROOMS = ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab")
ONLY_IN = {  # module or call -> the files that may
    "xml": ("calibration/formats/qualisys.py",),  # entities are refused there
    "Image.open": (
        "capture/photos/picture_files.py",
    ),  # the doors of docs/security.md, which ask for sizes first
    "cv2.imdecode": ("capture/photos/upright_pictures.py",),
    "rawpy.imread": ("capture/photos/raw.py",),
    "npy.read_array": ("capture/system/arrays.py",),
    "torch.load": ("flow/raft/weights_file.py",),
    "yaml.load": (
        "pipelines/config/text.py",
        "calibration/formats/kalibr.py",
    ),  # by a SafeLoader of their own
    "socket.socket": ("pipelines/viewer/command.py",),  # the one command that listens, on loopback by default
    "viser.ViserServer": ("pipelines/viewer/server.py",),
}
NEVER = {
    "pickle", "shelve", "marshal", "dill", "cloudpickle", "joblib", "np.load", "numpy.load", "np.fromfile", "np.memmap",
    "np.loadtxt", "np.genfromtxt", "cv2.imread", "cv2.imreadmulti", "cv2.VideoCapture", "eval", "exec", "compile",
    "os.system", "os.popen", "yaml.unsafe_load", "yaml.full_load", "yaml.load_all", "tarfile", "shutil.unpack_archive",
    "torch.jit.load", "torch.hub.load", "http", "socketserver", "asyncio", "ftplib", "flask", "aiohttp", "uvicorn",
    "socket.create_server",
}  # fmt: skip
EXTRACTS = ("extract", "extractall")  # of an archive: names in it would decide where files go


def complaints(source: str, file: str) -> Iterator[str]:
    """What a file has that it may not."""
    for node in ast.walk(ast.parse(source)):
        line = f"{file}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Import | ast.ImportFrom):
            module = node.module if isinstance(node, ast.ImportFrom) else None
            names = [module] if module else [alias.name for alias in node.names]
            for top in {name.split(".")[0] for name in names}:
                if top in NEVER or (top in ONLY_IN and file not in ONLY_IN[top]):
                    yield f"{line}: imports {top}"
        elif isinstance(node, ast.Constant) and node.value == "-m":
            yield f"{line}: python -m, which looks for modules in the working folder (capture.processes.run_module)"
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            given = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if called in NEVER or (called in ONLY_IN and file not in ONLY_IN[called]):
                yield f"{line}: calls {called}"
            if called == "torch.load" and given.get("weights_only") != "True":
                yield f"{line}: torch.load without weights_only=True"
            if called == "yaml.load" and not given.get("Loader", "").endswith("_Loader"):
                yield f"{line}: yaml.load without a loader of ours"
            if called.startswith("subprocess.") and given.get("shell", "False") != "False":
                yield f"{line}: a shell"
            if given.get("allow_pickle", "False") != "False":
                yield f"{line}: allow_pickle"
            if isinstance(node.func, ast.Attribute) and node.func.attr in EXTRACTS:
                yield f"{line}: unpacks an archive by the names in it"


def test_no_file_is_code_and_only_the_viewer_opens_a_port() -> None:
    files = [path for room in ROOMS for path in (REPOSITORY / room).rglob("*.py")]
    assert len(files) > 200
    found = [
        c for path in files for c in complaints(path.read_text(), path.relative_to(REPOSITORY).as_posix())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line",
    [
        "import pickle", "socket.socket()", "viser.ViserServer()",
        "from pickle import loads", "import http.server", "socket.create_server(a)", "np.load(path)",
        "numpy.load(path)", "yaml.load(text)", "yaml.load(text, Loader=yaml.UnsafeLoader)", "eval(text)",
        "subprocess.run(text, shell=True)", "torch.load(path)", "torch.load(path, weights_only=False)",
        "archive.extractall(folder)", "npy.read_array(file, allow_pickle=True)", "from xml.dom import minidom",
        "Image.open(path)", "cv2.imread(str(path))", "cv2.imdecode(data, 1)", "npy.read_array(file)",
        "run([sys.executable, '-m', 'devrf.worker'])",
    ],
)  # fmt: skip
def test_the_search_finds_what_it_is_for(line: str) -> None:
    assert list(complaints(line, "capture/new.py"))


def test_loaders_are_safe_ones() -> None:
    import yaml

    from devrf.calibration.formats import kalibr
    from devrf.pipelines.config import text

    for loader in (kalibr._Loader, text._Loader):
        assert issubclass(loader, yaml.SafeLoader)
        with pytest.raises(yaml.YAMLError):
            yaml.load("!!python/object/apply:os.getpid []", Loader=loader)


def test_nothing_is_imported_from_the_folder_of_a_scene(tmp_path: Path) -> None:
    """A scene's folder may hold a `yaml.py`: the current folder is not where modules come from."""
    import subprocess
    import sys

    (tmp_path / "yaml.py").write_text("print('run'); raise SystemExit(7)")
    script = Path(sys.executable).with_name("devrf-pipeline")
    result = subprocess.run(
        [script, "run", "scene.yaml"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 2 and "run\n" not in result.stdout, result.stdout + result.stderr
