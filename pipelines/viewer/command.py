"""`devrf-pipeline view`: walk through a scene in a browser, also while it is being trained."""

import errno
import os
import socket
import threading

from devrf.capture.system.errors import DevrfError, InputError
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.run_folder.lock import is_held
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.terminal.exit_codes import STOPPED
from devrf.pipelines.terminal.signals import stopped_by_signals
from devrf.pipelines.viewer.own_address import Address, is_loopback

INSTALL = "python -m pip install 'devrf[viewer]'; in a clone: python -m pip install -e '.[viewer]'"
KINDNESS = 10  # niceness beside a run


def view(job: Run, device: str, at: Address) -> None:
    """Serve the viewer until the user stops it.

    Args:
        job: The run to be looked at; nothing of it runs.
        device: auto, cpu or cuda; auto leaves the GPU to a run that is at work.
        at: Where.
    Raises:
        InputError: The run folder, the library, the port or the device is not there.
    """
    if not job.run_dir.is_dir():
        raise InputError(
            "run-missing",
            f"{job.run_dir}: nothing has been run yet; run the scene first (devrf-pipeline run), then or "
            "meanwhile view it",
        )
    try:
        import viser  # noqa: F401 (whether it is there)
    except ModuleNotFoundError as error:
        text = f"view needs the extra `viewer` ({error.name} is not installed): {INSTALL}"
        raise InputError("package-missing", text) from None
    _check_free(at)
    if is_held(job.run_dir):
        os.nice(KINDNESS)
        if device == "auto":
            device = "cpu"
            job.talk.say("a run is at work here: the viewer takes the CPU and stands back for it")
    device = resolve_device(device, job.config.budget.gpu_memory_gb)
    if not is_loopback(at.host):
        job.talk.say(
            f"warning: --host {at.host} lets everyone in this network see the scene and its pictures; nobody is "
            "asked for a password",
            style="yellow",
        )
    from devrf.pipelines.viewer.server import Site

    with stopped_by_signals():
        try:
            site = Site(job.config, job.run_dir, device, at)
        except OSError as error:
            text = f"--port {at.port}: cannot be served ({error.strerror or error})"
            raise DevrfError("port-unusable", text) from None
        try:
            job.talk.say(f"{at} (Ctrl-C ends it)")
            threading.Event().wait()
        finally:
            if not site.close():
                os._exit(STOPPED)  # Python would crash where it took itself apart beside native code


def _check_free(at: Address) -> None:
    """Refuse an address that is not this machine's, and a port that is taken; name one that is free."""
    try:
        _free(at.host, at.port)
    except socket.gaierror as error:
        text = f"--host {at.host}: not known ({error.strerror}); expected an address such as 127.0.0.1"
        raise InputError("host-unknown", text) from None
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            text = f"--host {at.host}: no address of this machine; expected one, such as 127.0.0.1, or 0.0.0.0 for all"
            raise InputError("host-elsewhere", text) from None
        what = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        text = f"--port {at.port}: {what}; try --port {_free(at.host, 0)}"
        raise InputError("port-unusable", text) from None


def _free(host: str, port: int) -> int:
    """A port that can be served: this one, or any where it is 0.

    Raises:
        OSError: It cannot.
    """
    family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((host, port))
        return probe.getsockname()[1]
