"""``pixcal`` and ``python`` for the blocks of the documentation, forked from a warm process.

Each call is a process of its own, with the caller's folder, arguments, environment and standard
streams, as it would be anyway; only the import of all libraries, a second or two, is done once.
"""

import array
import contextlib
import gc
import json
import os
import pkgutil
import runpy
import signal
import socket
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

CLIENT = """#!{python} -SE
import array, json, os, signal, socket, sys
server = socket.socket(socket.AF_UNIX)
server.connect({address!r})
streams = array.array("i", [0, 1, 2])
server.sendmsg([b"."], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
call = [{program!r}, sys.argv[1:], os.getcwd(), dict(os.environ)]
answers = server.makefile("rw")
answers.write(json.dumps(call) + "\\n")
answers.flush()
child = int(answers.readline())
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda received, frame: os.kill(child, received))
sys.exit(int(answers.readline() or 1))
"""


def serve(folder: Path) -> None:
    """Put the programs into a folder and answer their calls, until the process is ended."""
    _import_all()
    address = folder / "socket"
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(address))
    server.listen()
    for program in ("pixcal", "python"):
        file = folder / program
        text = CLIENT.format(python=sys.executable, address=str(address), program=program)
        file.write_text(text, encoding="utf-8")
        file.chmod(0o755)
    print("ready", flush=True)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    # What is there stays as it is: the children need not copy it.
    gc.freeze()
    while True:
        caller, _ = server.accept()
        if os.fork() == 0:
            server.close()
            os._exit(_answer(caller))
        caller.close()


def _import_all() -> None:
    for package in ("pixcal", "blind_examination", "pixcal_cli"):
        for found in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
            import_module(found.name)
    for library in ("xarray", "dask.array", "distributed", "numcodecs.zarr3"):
        with contextlib.suppress(ImportError):
            import_module(library)


def _answer(caller: socket.socket) -> int:
    """Do one call in this process, a child of the server."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    streams = array.array("i")
    _, passed, *_ = caller.recvmsg(1, socket.CMSG_LEN(3 * streams.itemsize))
    streams.frombytes(passed[0][2])
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    answers = caller.makefile("rw")
    program, arguments, folder, environment = json.loads(answers.readline())
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    answers.write(f"{os.getpid()}\n")
    answers.flush()
    code = _run(program, arguments)
    with contextlib.suppress(OSError):
        answers.write(f"{code}\n")
        answers.flush()
    return code


def _run(program: str, arguments: list[str]) -> int:
    sys.argv = [program, *arguments]
    try:
        if program == "pixcal":
            from pixcal_cli.main import main

            main()
        elif arguments[0] == "-c":
            sys.path[0] = ""
            exec(arguments[1], {"__name__": "__main__"})  # noqa: S102 (a block of the pages)
        else:
            # Absolute: multiprocessing looks for it from where the server began.
            file = Path(arguments[0]).resolve()
            sys.argv, sys.path[0] = arguments, str(file.parent)
            runpy.run_path(str(file), run_name="__main__")
        code: Any = 0
    except SystemExit as ended:
        code = ended.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    if isinstance(code, str):
        print(code, file=sys.stderr)
        code = 1
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    return int(code or 0)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
