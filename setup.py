"""Compiles the C++ kernels when the package is installed; all else is in pyproject.toml."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext


def _load_builder() -> ModuleType:
    """learner.kernels.build, which needs nothing but Python; the package is not installed yet."""
    path = Path(__file__).parent / "learner" / "kernels" / "build.py"
    spec = importlib.util.spec_from_file_location("build_kernel", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


builder = _load_builder()


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
