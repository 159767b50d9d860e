"""Work that loads a scene, in a process of its own: the service's own Dr.Jit belongs to the render thread, and what the
work took is given back when its process ends."""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

from service.errors import BusyError

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def run_apart(
    function: Callable[Parameters, Result], *arguments: Parameters.args, **named: Parameters.kwargs
) -> Result:
    """Calls a function of a module's top level in a new process and waits for it.

    Raises:
        BusyError: the process died.
        Exception: what the function raises.
    """
    # Not forked: a fork would hold the threads' locks of torch and Dr.Jit as they happen to be.
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, *arguments, **named).result()
        except BrokenProcessPool as error:
            raise BusyError("the process that did this died, out of memory perhaps; ask again later") from error
