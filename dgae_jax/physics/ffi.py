"""A Python function as a custom call of XLA: the CPU calls it by name, with views of its own buffers.

`jax.pure_callback` writes the address of the function into the program, so that JAX cannot keep the program in its compilation cache,
and takes every array through JAX. The structures are those of `xla/ffi/api/c_api.h`, whose versions XLA supports for a year at least.
"""

import ctypes
import functools
import math
from collections.abc import Callable, Sequence

import jax
import numpy as np

_MAJOR, _MINOR = 0, 1  # of the interface; JAX 0.10 and 0.12 accept it
_DTYPES = {1: np.bool_, 4: np.int32, 8: np.uint32, 11: np.float32, 12: np.float64}
_INTERNAL = 13
"""XLA's error code of a defect in the called function."""

Function = Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], None]
"""Reads the arrays of its first argument and fills those of its second."""


class _Struct(ctypes.Structure):
    """What nearly all of them begin with; the names below are those of the header."""

    _fields_ = (("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p))


class _Buffer(_Struct):
    _fields_ = (
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(_Struct):
    _fields_ = (
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _Version(_Struct):
    _fields_ = (("major", ctypes.c_int), ("minor", ctypes.c_int))


class _Metadata(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("version", _Version),
        ("traits", ctypes.c_uint32),
    )


class _MetadataRequest(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    )


class _ErrorArguments(_Struct):
    _fields_ = (("message", ctypes.c_char_p), ("code", ctypes.c_int))


class _Api(_Struct):
    _fields_ = (
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("error_create", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))),
    )


class _CallFrame(_Struct):
    _fields_ = (
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))
_registered: dict[str, object] = {}  # what XLA has a pointer to must stay


def register(name: str, function: Function) -> None:
    """Let programs on the CPU call `function` by a name, which must stand for the same function in every process.

    An exception in it ends the program with `jax.errors.JaxRuntimeError`. A name that is registered already is left as it is.
    """
    if name not in _registered:
        _registered[name] = handler = _Handler(functools.partial(_handle, function))
        jax.ffi.register_ffi_target(
            name, jax.ffi.pycapsule(ctypes.cast(handler, ctypes.c_void_p)), platform="cpu"
        )


def _handle(function: Function, pointer) -> int | None:
    frame = pointer.contents
    if frame.extension:  # XLA asks for the version and no more
        metadata = ctypes.cast(
            frame.extension, ctypes.POINTER(_MetadataRequest)
        ).contents.metadata.contents
        metadata.version.major, metadata.version.minor, metadata.traits = _MAJOR, _MINOR, 0
        return None
    try:
        function(_arrays(frame.arguments), _arrays(frame.results))
    except BaseException as reason:  # nothing may leave through XLA
        message = f"{type(reason).__name__}: {reason}".encode()
        arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, _INTERNAL)
        return frame.api.contents.error_create(ctypes.byref(arguments))
    return None


def _arrays(buffers: _Buffers) -> list[np.ndarray]:
    each = [buffers.buffers[i].contents for i in range(buffers.size)]
    return [_view(buffer.data, buffer.dtype, tuple(buffer.dims[: buffer.rank])) for buffer in each]


@functools.lru_cache(
    1024
)  # a loop calls with the same buffers again and again; a view lives only through one call
def _view(address: int | None, dtype: int, shape: tuple[int, ...]) -> np.ndarray:
    number = np.dtype(_DTYPES[dtype])
    memory = (ctypes.c_char * (math.prod(shape) * number.itemsize)).from_address(
        address or 0
    )  # no elements, no address
    return np.ndarray(shape, number, memory)  # pyright: ignore[reportArgumentType, reportCallIssue]
