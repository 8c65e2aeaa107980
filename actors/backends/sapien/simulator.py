"""The SAPIEN backend of `actors.simulator.Simulator`."""

from __future__ import annotations

from collections.abc import Mapping

import sapien

from actors.backends import eye
from actors.backends.base import BaseSimulator
from actors.backends.sapien import graphics
from actors.backends.sapien.renderer import Renderer
from actors.backends.sapien.world import RobotBuilder, World
from actors.simulator import UNTURNED, Array, Diagnosis, Scene
from proto.config import SimulatorConfig
from proto.disturbances import Ability
from sim_assets.built_visuals import Visual
from sim_assets.icub import EYE


class SapienSimulator(BaseSimulator[World, Renderer]):
    """Plays scenes in SAPIEN."""

    name = "sapien"
    abilities = frozenset(Ability)

    def __init__(self, config: SimulatorConfig) -> None:
        """Make the simulator; see `BaseSimulator` for errors."""
        super().__init__(config)
        self._builder = RobotBuilder(self._model)

    @staticmethod
    def diagnose() -> Diagnosis:
        """Try whether SAPIEN can render on this machine."""
        return graphics.diagnose()

    def _require_graphics(self) -> None:
        graphics.require_graphics()

    def _make_world(self, scene: Scene, start_rad: Array) -> World:
        period_s = self._config.physics_period_s
        return World(self._builder, self._model.joints, scene, start_rad, period_s)

    def _make_renderer(self, robot: tuple[Visual, ...], scene: Scene, *, shadows: bool) -> Renderer:
        renderer = Renderer(robot, shadows=shadows)
        renderer.set_scene(scene)
        return renderer

    def _eye_place(self, poses: Mapping[str, sapien.Pose], scene: Scene) -> sapien.Pose:
        place = poses[EYE]
        return place if scene.eye_turn == UNTURNED else place * sapien.Pose(q=scene.eye_turn)

    def _outside_place(self) -> sapien.Pose:
        return sapien.Pose(eye.outside_pose())
