"""Commands of the lab: there by their entry points, and missed in plain words without them."""

import pytest
import typer
from typer.testing import CliRunner

from devrf.pipelines.cli import installed as cli_installed
from devrf.pipelines.terminal.exit_codes import BAD_INPUT


def _app() -> typer.Typer:
    app = typer.Typer()
    cli_installed.add_installed(app)
    return app


def test_they_are_declared() -> None:
    for name, option in (("simulate", "--protocol"), ("bench", "stability")):
        result = CliRunner().invoke(_app(), [name, "--help"])
        assert result.exit_code == 0 and option in result.output


def test_an_installation_without_entry_points_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli_installed, "GROUP", "devrf.no-such-group")
    app = _app()
    assert {"simulate", "bench"} <= set(CliRunner().invoke(app, ["--help"]).output.split())
    for arguments in (["simulate", "out", "--size", "64x64"], ["bench", "stability", "--minutes", "1"]):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == BAD_INPUT
        assert arguments[0] in result.output and "pip install" in result.output
