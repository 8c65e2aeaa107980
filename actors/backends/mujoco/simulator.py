"""The MuJoCo backend of `actors.simulator.Simulator`."""

from __future__ import annotations

import mujoco
import numpy as np

from actors.backends import eye
from actors.backends.base import BaseSimulator
from actors.backends.mujoco import graphics
from actors.backends.mujoco.renderer import Renderer
from actors.backends.mujoco.world import RobotBuilder, World
from actors.simulator import UNTURNED, Array, Bodies, Diagnosis, Pose, Scene
from proto.config import SimulatorConfig
from proto.disturbances import Ability
from sim_assets.built_visuals import Visual
from sim_assets.icub import EYE


class MujocoSimulator(BaseSimulator[World, Renderer]):
    """Plays scenes in MuJoCo."""

    name = "mujoco"
    abilities = frozenset(Ability)

    def __init__(self, config: SimulatorConfig) -> None:
        """Make the simulator; see `BaseSimulator` for errors."""
        super().__init__(config)
        self._builder = RobotBuilder(self._model, config.physics_period_s)

    @staticmethod
    def diagnose() -> Diagnosis:
        """Try whether MuJoCo can render on this machine."""
        return graphics.diagnose()

    def close(self) -> None:
        """Free what the simulator holds."""
        for renderer in (self._eye_renderer, self._outside_renderer):
            if renderer is not None:
                renderer.close()
        super().close()

    def _require_graphics(self) -> None:
        graphics.find_driver()

    def _make_world(self, scene: Scene, start_rad: Array) -> World:
        return World(self._builder, scene, start_rad)

    def _make_renderer(self, robot: tuple[Visual, ...], scene: Scene, *, shadows: bool) -> Renderer:
        return Renderer(robot, scene, graphics.find_driver(), shadows=shadows)

    def _renewed(self, renderer: Renderer, scene: Scene) -> Renderer | None:
        if renderer.fits(scene):
            return super()._renewed(renderer, scene)
        renderer.close()
        return None

    def _eye_place(self, poses: Bodies, scene: Scene) -> Array:
        place = _matrix(poses[EYE])
        if scene.eye_turn == UNTURNED:
            return place
        turn: Array = place @ _matrix(Pose((0.0, 0.0, 0.0), scene.eye_turn))
        return turn

    def _outside_place(self) -> Array:
        return eye.outside_pose()


def _matrix(pose: Pose) -> Array:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.array(pose.quaternion))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.reshape(3, 3)
    matrix[:3, 3] = pose.position_m
    return matrix
