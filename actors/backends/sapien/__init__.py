"""The SAPIEN backend: PhysX for the physics, Vulkan for the pictures."""

import os

# Read by Mesa's software Vulkan when it is loaded. 0 draws in the calling thread; without it, Mesa
# starts a thread for each core in each process, and the processes compete for the cores.
os.environ.setdefault("LP_NUM_THREADS", "0")
