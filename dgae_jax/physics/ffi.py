"""Python functions as custom calls of XLA on the CPU, with views of its own buffers.

`jax.pure_callback` writes the address of the function into the program, so that JAX cannot keep
the program in its compilation cache, and takes every array through JAX. The structures below are
those of `xla/ffi/api/c_api.h`; XLA supports a version for at least a year.
"""

import ctypes
import functools
import math
from collections.abc import Callable, Sequence
from ctypes import CFUNCTYPE, POINTER, c_char, c_char_p, c_int, c_int64, c_size_t, c_void_p
from typing import Any

import jax
import numpy as np

_MAJOR, _MINOR = 0, 1  # of the interface; JAX 0.10 and 0.12 accept it
_DTYPES = {1: np.bool_, 4: np.int32, 8: np.uint32, 11: np.float32, 12: np.float64}
_INTERNAL = 13  # XLA's error code of a defect in the called function

Function = Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], None]
"""Reads the arrays of its first argument and fills those of its second."""


def _struct(**fields: Any) -> Any:
    """Return the type of a structure; the fields are named as in the C header."""
    return type("Struct", (ctypes.Structure,), {"_fields_": list(fields.items())})


_HEADER = {"struct_size": c_size_t, "extension": c_void_p}
_Buffer = _struct(**_HEADER, dtype=c_int, data=c_void_p, rank=c_int64, dims=POINTER(c_int64))
_Buffers = _struct(**_HEADER, size=c_int64, types=c_void_p, buffers=POINTER(POINTER(_Buffer)))
_Version = _struct(**_HEADER, major=c_int, minor=c_int)
_Metadata = _struct(struct_size=c_size_t, version=_Version, traits=ctypes.c_uint32)
_MetadataRequest = _struct(
    struct_size=c_size_t, type=c_int, next=c_void_p, metadata=POINTER(_Metadata)
)
_ErrorArguments = _struct(**_HEADER, message=c_char_p, code=c_int)
_CreateError = CFUNCTYPE(c_void_p, POINTER(_ErrorArguments))
_Api = _struct(**_HEADER, version=_Version, internal=c_void_p, error_create=_CreateError)
_CallFrame = _struct(
    **_HEADER, api=POINTER(_Api), context=c_void_p, stage=c_int, args=_Buffers, rets=_Buffers
)
_Handler = CFUNCTYPE(c_void_p, POINTER(_CallFrame))
_registered: dict[str, object] = {}  # XLA holds pointers to these


def register(name: str, function: Function) -> None:
    """Let programs on the CPU call `function` by a name.

    An exception in it ends the program with `jax.errors.JaxRuntimeError`.

    Args:
        name: target of `jax.ffi.ffi_call`, the same for a function in every process.
        function: reads and fills arrays; ignored if the name is registered already.
    """
    if name not in _registered:
        _registered[name] = handler = _Handler(functools.partial(_handle, function))
        capsule = jax.ffi.pycapsule(ctypes.cast(handler, c_void_p))
        jax.ffi.register_ffi_target(name, capsule, platform="cpu")


def _handle(function: Function, pointer) -> int | None:
    frame = pointer.contents
    if frame.extension:  # XLA only asks for the version
        request = ctypes.cast(frame.extension, POINTER(_MetadataRequest))
        metadata = request.contents.metadata.contents
        metadata.version.major, metadata.version.minor, metadata.traits = _MAJOR, _MINOR, 0
        return None
    try:
        function(_arrays(frame.args), _arrays(frame.rets))
    except BaseException as reason:  # nothing may leave through XLA
        message = f"{type(reason).__name__}: {reason}".encode()
        arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, _INTERNAL)
        return frame.api.contents.error_create(ctypes.byref(arguments))
    return None


def _arrays(buffers: Any) -> list[np.ndarray]:
    each = [buffers.buffers[i].contents for i in range(buffers.size)]
    return [_view(buffer.data, buffer.dtype, tuple(buffer.dims[: buffer.rank])) for buffer in each]


@functools.lru_cache(1024)  # a loop calls with the same buffers; a view lives through one call only
def _view(address: int | None, dtype: int, shape: tuple[int, ...]) -> np.ndarray:
    number = np.dtype(_DTYPES[dtype])
    size = math.prod(shape) * number.itemsize
    memory = (c_char * size).from_address(address or 0)  # an empty array has no address
    return np.ndarray(shape, number, memory)  # pyright: ignore[reportArgumentType, reportCallIssue]
