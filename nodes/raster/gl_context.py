"""OpenGL without a display: a context on an EGL device, its limits, its errors, its shader sources.

Whether OpenGL works is tried in a child process, so that a driver that crashes takes only the child with it.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Self

from ...shared.errors import DeviceError, InputError

if TYPE_CHECKING:
    import moderngl

_LIBRARY = "libEGL.so.1"
_VERSION = 450  # compute shaders came with 4.3; drivers take 64-bit atomics from GLSL 4.50 on
_PROBE_S = 60
_EGL_EXTENSIONS = 0x3055
_MOST_DEVICES = 64
_LOCAL_RANK = ("MPI_LOCALRANKID", "OMPI_COMM_WORLD_LOCAL_RANK", "SLURM_LOCALID")
"""Number of a rank on its host, by MPICH, Open MPI, srun; the innermost starter first."""
_FREE_MEMORY_KIB = {"GL_NVX_gpu_memory_info": 0x9049, "GL_ATI_meminfo": 0x87FC}  # extension → what to query


@cache
def gl_available() -> tuple[bool, str]:
    """(True, renderer) if the default EGL device draws, else (False, reason and what to install).

    Never raises. Cost: about half a second, the first time.
    """
    try:
        _check_installed()
        probe = subprocess.run(
            [sys.executable, "-m", __name__], capture_output=True, text=True, timeout=_PROBE_S, check=False
        )
    except (DeviceError, OSError, subprocess.SubprocessError) as error:
        return False, str(error)
    if probe.returncode == 0:
        return True, probe.stdout.strip()
    if probe.returncode < 0:
        return False, f"OpenGL: the driver crashed (signal {-probe.returncode})"
    return False, (probe.stderr.strip().splitlines() or ["OpenGL: the probe failed"])[-1]


def require_gl(what: str) -> None:
    """Raise DeviceError, naming ``what`` needs it and what to install, where the default EGL device does not draw."""
    available, why = gl_available()
    if not available:
        raise DeviceError(f"{what}: {why}")


def is_software(renderer: str) -> bool:
    """Whether a renderer string names a driver that draws on the CPU."""
    return any(name in renderer.lower() for name in ("llvmpipe", "softpipe", "swrast"))


def open_context(device_index: int) -> moderngl.Context:
    """A context on an EGL device, current in this thread; the caller releases it.

    device_index : in the order of EGL, which is not that of CUDA; 0: that of this rank (``device_of_rank``).
        GLCONTEXT_DEVICE_INDEX in the environment wins.
    Raises DeviceError: moderngl or a library is missing, no such device, or OpenGL is older than 4.5.
    """
    _check_installed()
    import moderngl

    device_index = device_index or device_of_rank()

    # EGL hands out the functions of OpenGL as well, so libGL, which comes with X, is not needed
    libraries = {"libegl": _LIBRARY, "libgl": _LIBRARY}
    settings: dict[str, Any] = {"backend": "egl", "device_index": device_index, **libraries}
    try:
        return moderngl.create_context(require=_VERSION, standalone=True, **settings)
    except Exception as error:  # the binding raises bare Exception
        index = os.environ.get("GLCONTEXT_DEVICE_INDEX", device_index)
        raise DeviceError(f"OpenGL: no OpenGL 4.5 on EGL device {index}: {error}") from error


def device_of_rank() -> int:
    """Index of the EGL device for this process: ranks of a host take its GPUs in turn, by their number there.

    0 where there are not several GPUs, or no starter of ranks says a number. Cost: none for the first rank of a host.
    """
    numbers = (os.environ[name] for name in _LOCAL_RANK if os.environ.get(name, "").isdigit())
    local_rank = int(next(numbers, 0))
    if not local_rank:
        return 0
    gpus = hardware_devices()
    return gpus[local_rank % len(gpus)] if len(gpus) > 1 else 0


def hardware_devices() -> list[int]:
    """Indices of the EGL devices that are no software; empty where EGL does not say.

    A scheduler that confines a job to some GPUs leaves only those to EGL; CUDA_VISIBLE_DEVICES alone does not.
    """
    library = ctypes.CDLL(_LIBRARY)
    library.eglGetProcAddress.restype = ctypes.c_void_p
    query = library.eglGetProcAddress(b"eglQueryDevicesEXT")
    describe = library.eglGetProcAddress(b"eglQueryDeviceStringEXT")
    if not (query and describe):
        return []
    devices, n = (ctypes.c_void_p * _MOST_DEVICES)(), ctypes.c_int()
    query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query)
    string_of = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)(describe)
    if not query_devices(_MOST_DEVICES, devices, ctypes.byref(n)):
        return []
    said = [string_of(devices[i], _EGL_EXTENSIONS) or b"" for i in range(n.value)]
    return [i for i, extensions in enumerate(said) if b"EGL_MESA_device_software" not in extensions]


class ContextOwner:
    """Owns an OpenGL context that draws frames of one size; a context manager, to be used from one thread."""

    device: str
    _context: moderngl.Context

    @contextmanager
    def _set_up(self, device_index: int, width: int, height: int, doing: str) -> Iterator[None]:
        """Open the context; around what makes everything in it. Where that fails, nothing of it is left.

        Raises DeviceError: no OpenGL 4.5, or an error of OpenGL; InputError: a viewport that is empty or above the
        texture size.
        """
        import moderngl

        self._context = open_context(device_index)
        try:
            self.device = str(self._context.info["GL_RENDERER"])
            most = self._context.info["GL_MAX_TEXTURE_SIZE"]
            if not (1 <= width <= most and 1 <= height <= most):
                raise InputError(f"viewport: found {width}×{height}, expected 1…{most} px a side")
            yield
            check_errors(self._context, doing)
        except moderngl.Error as error:
            self.close()
            raise DeviceError(f"OpenGL: {' '.join(str(error).split())}") from error
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the context and with it all device memory. May be called twice."""
        self._context.release()


def storage_limit(context: moderngl.Context) -> int:
    """Bytes of the largest storage block. A driver whose limit overflows the query's 32 bits gets 2³¹ − 1."""
    limit = context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]
    return limit if limit > 0 else 2**31 - 1


def device_memory(context: moderngl.Context) -> int | None:
    """Bytes of memory that are free on the device, None where the driver does not say."""
    for extension, name in _FREE_MEMORY_KIB.items():
        if extension in context.extensions:
            library = ctypes.CDLL(_LIBRARY)
            library.eglGetProcAddress.restype = ctypes.c_void_p
            get_integers = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_void_p)(
                library.eglGetProcAddress(b"glGetIntegerv")
            )
            free = (ctypes.c_int * 4)()
            get_integers(name, free)
            return free[0] << 10
    return None


def check_errors(context: moderngl.Context, doing: str) -> None:
    """Raise DeviceError if OpenGL flagged an error since the last call: it raises nothing by itself."""
    error = context.error
    if error != "GL_NO_ERROR":
        raise DeviceError(f"OpenGL: {error} while {doing} on {context.info['GL_RENDERER']}")


def shader_source(*names: str, extensions: tuple[str, ...] = (), defines: tuple[str, ...] = ()) -> str:
    """One GLSL source of the named files of ``shaders/`` behind its version, extensions and definitions."""
    folder = files(str(__package__)) / "shaders"
    lines = [f"#version {_VERSION}"]
    lines += [f"#extension {name} : require" for name in extensions]
    lines += [f"#define {name}" for name in defines]
    return "\n".join(lines + [(folder / f"{name}.glsl").read_text(encoding="utf-8") for name in names])


def _check_installed() -> None:
    if find_spec("moderngl") is None:
        raise DeviceError("OpenGL: moderngl is not installed; pip install 'splatpipe[gl]'")
    try:
        ctypes.CDLL(_LIBRARY)
    except OSError:
        raise DeviceError(
            f"OpenGL: {_LIBRARY} is missing; on Debian or Ubuntu: apt install libegl1 libgl1-mesa-dri"
        ) from None


def _probe() -> int:
    try:
        with open_context(0) as context:
            print(context.info["GL_RENDERER"])
    except DeviceError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_probe())
