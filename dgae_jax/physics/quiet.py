"""MuJoCo's warnings, counted instead of printed: left alone, each goes to stderr and to MUJOCO_LOG.TXT in the working directory."""

import contextlib
import logging
import threading
from collections import Counter

import mujoco
import numpy as np

_LOG = logging.getLogger(__name__)

COUNTS: Counter[str] = Counter()
"""How often C MuJoCo warned in this process while `native` stepped, by MuJoCo's name of the warning."""

KINDS = tuple(
    mujoco.mjtWarning(i).name.removeprefix("mjWARN_")
    for i in range(int(mujoco.mjtWarning.mjNWARNING))
)
"""BADQACC, CONTACTFULL, …: in MuJoCo's order."""


_LOCK, _inside, _usual = threading.Lock(), 0, None
"""How many callers are within `silenced`, and the handler that is usual outside of it."""


@contextlib.contextmanager
def silenced():
    """Within it, MuJoCo's warnings from any thread are neither printed nor written to a file."""
    global _inside, _usual
    with _LOCK:
        if not _inside:
            _usual = mujoco.get_mju_user_warning()
            mujoco.set_mju_user_warning(lambda message: None)
        _inside += 1
    try:
        yield
    finally:
        with _LOCK:
            _inside -= 1
            if not _inside:
                mujoco.set_mju_user_warning(_usual)


def count(numbers: np.ndarray) -> None:
    """Add new warnings, one number per kind; the first of each kind is said in one line, the others only counted."""
    for kind, number in zip(KINDS, numbers, strict=True):
        if number and kind not in COUNTS:
            _LOG.warning(
                "MuJoCo warns of %s in physics native; from now on its warnings are counted, not shown",
                kind,
            )
        if number:
            COUNTS[kind] += int(number)
