"""Compile the C++ kernels into one library, with the machine's own compiler.

The library is compiled when the package is installed, otherwise at its first use. Its name holds a
digest of the sources, the flags and the processor, so that a library for another processor or of
older sources is never loaded.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from proto.cache import cache_folder, private_folder, writable_by_others

LOG = logging.getLogger(__name__)

FOLDER: Final = Path(__file__).parent
SOURCES: Final = ("core.cpp", "adam.cpp", "mixing.cpp", "maps.cpp", "acting.cpp")
HEADERS: Final = ("vectors.h", "lanes.h", "threads.h")
FLAGS: Final = (
    "-std=c++17",
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fPIC",
    "-shared",
    "-pthread",
)
_COMPILERS: Final = ("c++", "g++", "clang++")


class NotCompiledError(Exception):
    """There is no library; the message gives the reason."""


def find_or_compile() -> Path:
    """The library for this machine: beside the sources, in the cache, or freshly compiled there.

    A library that others could have put there is not used: it could do anything. Instead of such a
    cache a folder of this user is used.

    Raises:
        NotCompiledError: there is no compiler, or it failed, or there is no safe folder.
    """
    beside = FOLDER / library_name()
    if beside.is_file():  # who can write there can change the sources as well
        return beside
    unsafe = []
    for folder in (cache_folder(), private_folder()):
        library = folder / library_name()
        if reason := writable_by_others(library):
            unsafe.append(reason)
            if library.exists():
                LOG.warning("%s is not used: %s", library, reason)
        elif library.is_file():
            return library
    for folder in (cache_folder(), private_folder()):
        if not writable_by_others(folder):
            return compile_into(folder)
    raise NotCompiledError(
        f"there is no folder for it that is safe from others: {'; '.join(dict.fromkeys(unsafe))}."
        " Name one in VMDNN_CACHE"
    )


def library_name() -> str:
    """File name of the library for these sources and this processor."""
    texts = ((FOLDER / name).read_text() for name in (*SOURCES, *HEADERS))
    parts = (*texts, " ".join(FLAGS), _processor())
    return f"kernels-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:16]}.so"


def compile_into(folder: Path) -> Path:
    """Compile the library into a folder; the file appears there only when it is complete.

    Raises:
        NotCompiledError: there is no compiler, or it failed.
    """
    compiler = _compiler()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            library = Path(scratch) / library_name()
            sources = [str(FOLDER / name) for name in SOURCES]
            command = [compiler, *FLAGS, *sources, "-o", str(library)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise NotCompiledError(f"{' '.join(command)} failed:\n{done.stderr.strip()}")
            return library.replace(folder / library.name)
    except OSError as error:
        raise NotCompiledError(f"it cannot be compiled into {folder}: {error}") from error


def _compiler() -> str:
    for name in filter(None, (os.environ.get("CXX"), *_COMPILERS)):
        found = shutil.which(name)
        if found is not None:
            return found
    raise NotCompiledError(f"there is no C++ compiler ({', '.join(_COMPILERS)})")


def _processor() -> str:
    """Description of the processor, on which -march=native depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    telling = ("model name", "flags", "Features", "CPU part")
    return "\n".join(sorted({line for line in lines if line.startswith(telling)}))
