"""Try to render one picture, as a script in its own process, because a bad driver can crash it.

The argument is the driver, "egl" or "osmesa". Prints one line of JSON: `device`, the name of the
device that rendered; `problem`, what went wrong, empty if nothing did.
"""

from __future__ import annotations

import json
import sys

import mujoco
import numpy as np

from actors.backends.mujoco.graphics import open_context


def main(driver: str) -> None:
    """Render and report."""
    device, problem = "", ""
    try:
        device = _render(driver)
    # PyOpenGL and EGL report a missing driver in many ways, among them AttributeError.
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    print(json.dumps({"device": device, "problem": problem}))


def _render(driver: str) -> str:
    """Render an empty scene; return the name of the device."""
    gl = open_context(driver)
    gl.make_current()
    model = mujoco.MjSpec().compile()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    view = mujoco.MjrRect(0, 0, 8, 6)
    mujoco.mjr_render(view, mujoco.MjvScene(model, maxgeom=1), context)
    mujoco.mjr_readPixels(np.empty((6, 8, 3), dtype=np.uint8), None, view, context)
    from OpenGL import GL  # noqa: PLC0415  # loads the driver that `open_context` has chosen

    device = GL.glGetString(GL.GL_RENDERER).decode()
    context.free()
    gl.free()
    return str(device)


if __name__ == "__main__":
    main(*sys.argv[1:])
