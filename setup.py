"""Compiles the C++ kernels when the package is installed; all else is in pyproject.toml."""

from __future__ import annotations

import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# The package is not installed yet. What is imported here needs nothing but Python.
sys.path.insert(0, str(Path(__file__).parent))
from learner.kernels import build as builder


class CompileKernel(build_ext):
    """Compiles with `learner.kernels.build`; without a compiler the package works all the same."""

    def get_ext_filename(self, fullname: str) -> str:
        """The library's own name in place of the module's."""
        *packages, _ = fullname.split(".")
        return str(Path(*packages, builder.library_name()))

    def build_extension(self, ext: Extension) -> None:
        """Compile it, or say why not."""
        try:
            builder.compile_into(Path(self.get_ext_fullpath(ext.name)).parent)
        except builder.NotCompiledError as error:
            self.warn(f"the C++ kernels are not compiled: {error}")


sources = [f"learner/kernels/{name}" for name in builder.SOURCES]
setup(
    ext_modules=[Extension("learner.kernels.library", sources, optional=True)],
    cmdclass={"build_ext": CompileKernel},
)
