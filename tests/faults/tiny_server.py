"""Starts runs of the tiny pipeline by forking a process that has imported everything: half the processor time.

    python -m tests.faults.tiny_server SOCKET

A request on the socket is JSON: `{"start": [arguments]}`, with the ends of two pipes for what the run prints, is
answered by the process number; `{"poll": number}` by how the process ended (os.waitstatus_to_exitcode) or null.
"""

import importlib.metadata  # noqa: F401  with those below: what the program imports when it needs it
import json
import os
import signal
import socket
import sys

import filelock  # noqa: F401
import psutil  # noqa: F401
import rich.console  # noqa: F401
import rich.progress  # noqa: F401
from tests.faults.tiny_stages import program

from devrf.pipelines.runner.supervise import supervised


def serve(requests: socket.socket) -> None:
    """Answer until the other end is closed. Returns in the forked processes too, when they have run."""
    while True:
        message, pipes, _, _ = socket.recv_fds(requests, 65536, 2)
        if not message:
            return
        request = json.loads(message)
        if "poll" in request:
            pid, status = os.waitpid(request["poll"], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if pid else None
        else:
            answer = os.fork()
            if answer == 0:
                requests.close()
                for number, pipe in enumerate(pipes, 1):
                    os.dup2(pipe, number)
                    os.close(pipe)
                sys.argv[1:] = request["start"]
                return supervised(program)
            for pipe in pipes:
                os.close(pipe)
        requests.sendall(json.dumps(answer).encode())


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
    serve(socket.socket(fileno=int(sys.argv[1])))
