"""Compiles the C++ kernels when the package is built; pyproject.toml has everything else."""

from __future__ import annotations

import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# The package is not installed yet. This module of it needs only Python's standard library.
sys.path.insert(0, str(Path(__file__).parent))
from learner.kernels import build as builder


class CompileKernel(build_ext):
    """Compiles with `learner.kernels.build`; without a compiler the package works, but slower."""

    def get_ext_filename(self, fullname: str) -> str:
        """Return the file name of the library, which differs from the module's name."""
        *packages, _ = fullname.split(".")
        return str(Path(*packages, builder.library_name()))

    def build_extension(self, ext: Extension) -> None:
        """Compile the library; warn if it cannot be compiled."""
        try:
            builder.compile_into(Path(self.get_ext_fullpath(ext.name)).parent)
        except builder.NotCompiledError as error:
            self.warn(f"the C++ kernels are not compiled: {error}")


sources = [f"learner/kernels/{name}" for name in builder.SOURCES]
setup(
    ext_modules=[Extension("learner.kernels.library", sources, optional=True)],
    cmdclass={"build_ext": CompileKernel},
)
