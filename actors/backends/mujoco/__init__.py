"""The MuJoCo backend: its own physics, and OpenGL for the pictures."""

import os

# Read by Mesa's software OpenGL when it is loaded. 0 draws in the calling thread; without it, Mesa
# starts a thread for each core in each process, and the processes compete for the cores.
os.environ.setdefault("LP_NUM_THREADS", "0")

# While it is imported, mujoco loads the graphics driver that this variable names. The renderer
# loads the driver itself, when there is something to render.
_driver = os.environ.get("MUJOCO_GL")
os.environ["MUJOCO_GL"] = "disable"
import mujoco  # noqa: E402, F401

del os.environ["MUJOCO_GL"]
if _driver is not None:
    os.environ["MUJOCO_GL"] = _driver
