"""The SAPIEN backend: PhysX for the physics, Vulkan for the pictures."""
