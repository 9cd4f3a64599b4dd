"""Compiling, which may take minutes inside XLA, while this process still listens."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

Watch = Callable[[str], None]
"""Told, now and then, what is going on; what it raises breaks it off."""

LOOK_EVERY = 0.5
"""Seconds between looks at the compiler."""

THREAD = "dgae_jax compiler"


def unwatched(_: str) -> None:
    """Tell nobody."""


def compile_aside(
    program: Any, *args: Any, watch: Watch = unwatched, what: str = "compiling"
) -> None:
    """Compile a jitted function for such arguments, so that calling it does not; in a thread, while this one waits.

    Python runs no signal handler as long as its main thread is inside of XLA. An exception that `watch` raises leaves the
    compiler to itself: it cannot be broken off, and holds up or aborts the end of the process unless that is `os._exit`.
    """
    since, done = time.monotonic(), Future()
    watch(what)
    lowered = program.lower(*args)  # here, where settings of this thread hold

    def work():
        try:
            done.set_result(lowered.compile())
        except BaseException as reason:
            done.set_exception(reason)

    threading.Thread(target=work, daemon=True, name=THREAD).start()
    while True:
        try:
            done.result(LOOK_EVERY)
            return
        except TimeoutError:
            if done.done():
                raise
            watch(f"{what}, {time.monotonic() - since:.0f} s")


def is_running() -> bool:
    """Whether a compiler was left to itself and has not finished."""
    return any(thread.name == THREAD and thread.is_alive() for thread in threading.enumerate())
