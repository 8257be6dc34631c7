"""The ``caphy`` command: one subcommand per module of ``caphy.commands``, imported only when asked for."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import NoReturn

from caphy.errors import CaphyError

COMMANDS = {
    "body": "make, inspect and picture SMPL-X-format bodies",
    "poses": "inspect, convert and picture pose files",
    "garment": "make garment templates and check your own meshes",
    "register": "find the body under the clothes of scans, and the garments' templates",
    "effects": "list and show the physical effects",
    "simulate": "drape or move a garment with the reference solver",
    "capture-sim": "scan a simulated person, with the truth kept aside",
    "scans": "check, picture and convert sets of scans",
    "segment": "tell skin, upper and lower garment apart on scans",
    "train": "train a garment network with physics losses",
    "fabric": "fit the stiffness of the clothes to the scans they were worn in",
    "collide": "fine-tune garments worn together until they stop passing through each other",
    "validate": "hold a trained network against the reference solver",
    "compare": "compare a model with measurements: metrics, and a page to look at",
    "diagnose": "tell which physical effect a model lacks",
    "refit": "add an effect to a model and fit its parameters to measurements",
    "challenge": "make measurements with a hidden effect, and open the sealed answer",
    "evaluate": "hold dressed avatars against scans that nothing was trained on",
    "fit": "from scans of a person to an avatar, in one go",
    "export": "write an avatar bundle: one ONNX graph per garment",
    "serve": "serve avatars over HTTP",
    "demo": "serve the default avatar, send it a motion, write a GLB and a contact sheet",
}
LISTS = ("--base", "--held-out", "--effect-file", "--poses", "--motions", "--garments", "--kinds", "--betas")
"""Options with any number of values; given twice, the last ones alone would count."""
SAME = {"--kinds": "--garments"}
"""Options of two names."""
STATUSES = """exit status: 0 done; 1 a part failed, or the result was refused (what a refit does not bear out);
  2 input to put right, which one line says; 130 and 143 stopped by Ctrl-C and SIGTERM"""
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM


def usage() -> str:
    """The top-level help text."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name.ljust(width)}  {summary}" for name, summary in COMMANDS.items()]
    return "\n".join(["usage: caphy COMMAND [OPTIONS]   (caphy COMMAND --help for more)", "", *lines, "", STATUSES])


def command() -> NoReturn:
    """Run what the command line asks for, as a program."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _once)
    signal.signal(signal.SIGTERM, _once)  # of timeout and of queues of batches
    status = main()
    if status in (INTERRUPTED, TERMINATED):
        # threads that write to processes which are gone would be waited for for ever
        if (util := sys.modules.get("multiprocessing.util")) is not None:
            # held, or a thread that ends lets go of its semaphore, and would be stopped amid clearing that away
            held = [each() for ended in list(util._finalizer_registry.values()) if (each := ended._weakref) is not None]
            for child in sys.modules["multiprocessing"].active_children():
                child.kill()  # one that still begins would miss its semaphores
                child.join()
            for thread in threading.enumerate():  # those that clear away after them, and would be stopped amid it
                if not thread.daemon and thread is not threading.main_thread():
                    thread.join(timeout=1)
            util._run_finalizers(0)  # or its tracker complains of semaphores
            del held
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def _once(number: int, frame: FrameType | None) -> NoReturn:
    """End at the first Ctrl-C; further ones, as of the impatient and of ``timeout``, would break off the ending."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt(128 + number)


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand; returns the exit status (2 for input the user can put right)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    if arguments[0] == "--version":
        from caphy import __version__

        print(f"caphy {__version__}")
        return 0
    name, rest = arguments[0], arguments[1:]
    if name not in COMMANDS:
        print(f"caphy: there is no command {name!r}\n\n{usage()}", file=sys.stderr)
        return 2
    if "" in rest:
        return _refused(name, "an argument is empty; is a variable of your shell not set?")
    given = [argument.split("=", maxsplit=1)[0].replace("_", "-") for argument in rest]
    given = [SAME.get(option, option) for option in given]
    if twice := [option for option in LISTS if given.count(option) > 1]:
        return _refused(name, f"{twice[0]} is given twice; give all its values after one {twice[0]}")
    return _run(name, rest)


def _run(name: str, rest: list[str]) -> int:
    try:
        status = importlib.import_module(f"caphy.commands.{name.replace('-', '_')}").main(rest) or 0
        sys.stdout.flush()
        return status
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("caphy", "service", "export"):
            raise
        return _refused(name, f"needs {error.name!r}; install it with: pip install 'caphy[train]'")
    except CaphyError as error:
        return _refused(name, str(error))
    except BrokenPipeError:  # whoever reads our output has seen enough, as in caphy effects list | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains at exit
        return 128 + signal.SIGPIPE
    except (KeyboardInterrupt, SystemError) as error:
        if (stopped := _interrupt(error)) is None:
            raise
        return stopped.args[0] if stopped.args else INTERRUPTED
    except OSError as error:  # a place that cannot be read or written, a full disk
        if error.strerror is None:
            raise
        place = error.filename2 or error.filename  # of a copy where it goes
        return _refused(name, f"{place}: {error.strerror}" if place else f"{error.strerror}, where a file is written")


def _interrupt(error: BaseException | None) -> KeyboardInterrupt | None:
    """What an error comes from, if it is a signal: compiled code that one comes upon tells of it by a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error


def _refused(name: str, why: str) -> int:
    print(f"caphy {name}: {why}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    command()
