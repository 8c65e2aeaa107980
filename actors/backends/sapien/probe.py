"""Try to render one picture, as a script in its own process, because a bad driver can crash it.

Prints one line of JSON: `device`, the name of the device that rendered it; `known`, name and driver
of every device that Vulkan finds; `problem`, what went wrong, empty if nothing did.
"""

from __future__ import annotations

import ctypes
import json
from pathlib import Path

import sapien
from sapien import render


def main() -> None:
    """Render and report."""
    device, problem = "", ""
    try:
        system = render.RenderSystem()
        _render(system)
        device = system.device.name
    except RuntimeError as error:
        problem = str(error)
    print(json.dumps({"device": device, "known": known_devices(), "problem": problem}))


def _render(system: render.RenderSystem) -> None:
    scene = sapien.Scene([system])
    camera = render.RenderCameraComponent(8, 6, str(Path(__file__).parent / "shader" / "eye"))
    entity = sapien.Entity()
    entity.add_component(camera)
    scene.add_entity(entity)
    system.step()
    camera.take_picture()
    camera.get_picture("Color")


class _ApplicationInfo(ctypes.Structure):
    """VkApplicationInfo."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("application", ctypes.c_char_p),
        ("application_version", ctypes.c_uint32),
        ("engine", ctypes.c_char_p),
        ("engine_version", ctypes.c_uint32),
        ("api_version", ctypes.c_uint32),
    )


class _InstanceCreateInfo(ctypes.Structure):
    """VkInstanceCreateInfo."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("application", ctypes.POINTER(_ApplicationInfo)),
        ("layer_count", ctypes.c_uint32),
        ("layers", ctypes.c_void_p),
        ("extension_count", ctypes.c_uint32),
        ("extensions", ctypes.c_void_p),
    )


class _DriverProperties(ctypes.Structure):
    """VkPhysicalDeviceDriverProperties."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("id", ctypes.c_uint32),
        ("name", ctypes.c_char * 256),
        ("info", ctypes.c_char * 256),
        ("conformance", ctypes.c_uint8 * 4),
    )


class _DeviceProperties(ctypes.Structure):
    """VkPhysicalDeviceProperties2; only the first of its properties are named."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.POINTER(_DriverProperties)),
        ("versions_and_ids", ctypes.c_uint32 * 5),
        ("name", ctypes.c_char * 256),
        ("rest", ctypes.c_uint8 * 2048),
    )


_VULKAN_1_2 = 1 << 22 | 2 << 12


def known_devices() -> list[tuple[str, str]]:
    """Name and driver of every device that Vulkan finds, whether SAPIEN can use it or not.

    SAPIEN itself only says that it found no device that it can use.
    """
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return []
    application = _ApplicationInfo(type=0, api_version=_VULKAN_1_2)
    info = _InstanceCreateInfo(type=1, application=ctypes.pointer(application))
    instance = ctypes.c_void_p()
    if vulkan.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)) != 0:
        return []
    count = ctypes.c_uint32(16)
    devices = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
    found = [_describe(vulkan, device) for device in devices[: count.value]]
    vulkan.vkDestroyInstance(instance, None)
    return found


def _describe(vulkan: ctypes.CDLL, device: int | None) -> tuple[str, str]:
    driver = _DriverProperties(type=1000196000)
    properties = _DeviceProperties(type=1000059001, next=ctypes.pointer(driver))
    vulkan.vkGetPhysicalDeviceProperties2(ctypes.c_void_p(device), ctypes.byref(properties))
    return properties.name.decode(), f"{driver.name.decode()} {driver.info.decode()}"


if __name__ == "__main__":
    main()
