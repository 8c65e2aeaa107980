"""Plays one episode: observe, choose an action, move, judge (paper, section 3.2)."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.attention import clip_action, crop_of_focus, targets_of_action, with_attention_of
from actors.disturbances.staging import Staging, checked_staging
from actors.policies.contract import InformedPolicy, ObservablePolicy, Policy
from actors.simulator import Bodies, Crop, Scene, Simulator
from actors.tasks.contract import Task
from actors.view import view_of
from proto.body import FOCUS
from proto.episode import LOCAL, Episode, Floats, Image, Kind
from proto.suites import Conditions
from proto.variables import Situation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LiveStep:
    """One control step, for live display.

    Attributes:
        step: control step, from 0.
        phase: name of the phase.
        image: (48, 64) uint8, the network's picture.
        joints_deg: (18,) measured before the action (degrees).
        action: (11,) the commanded action.
        bodies: where all bodies are before the action.
        scene: what the episode began with.
        crop: the part of the eye image that is seen.
        pfc: (units,) activity of the policy's PFC; None if it has none.
    """

    step: int
    phase: str
    image: Image
    joints_deg: Array
    action: Array
    bodies: Bodies
    scene: Scene
    crop: Crop
    pfc: Floats | None = None


def play(
    simulator: Simulator,
    task: Task,
    policy: Policy,
    situation: Situation,
    *,
    seed: int,
    kind: Kind,
    actor: str = LOCAL,
    config_digest: str = "",
    on_step: Callable[[LiveStep], None] | None = None,
    conditions: Conditions | None = None,
    staging: Staging | None = None,
) -> Episode:
    """Play one episode from the task's start posture.

    At step t the policy sees images[t], cropped by the robot's focus level. The robot receives the
    command actions[t] and moves for one control period.

    Args:
        simulator: simulator that plays the scene.
        task: the task.
        policy: policy that chooses the actions.
        situation: values of the task's variables by name.
        seed: seed of all random numbers in the episode.
        kind: why the episode is played.
        actor: id of the process that plays it.
        config_digest: digest of the effective configuration.
        on_step: called in each control step before the robot moves. An exception that it raises
            ends the episode at once.
        conditions: the conditions of the suite that the episode belongs to; None for an episode
            without disturbances inside the ranges. The recorded pictures are those that the policy
            saw. The judge measures from where the object is after an outside hand moved it.
        staging: what `checked_staging` gives for it, which can be played once; None to make it.

    Raises:
        UserError: the situation is not valid for the task, or task or simulator cannot be disturbed
            as the conditions say.
    """
    if staging is None:
        staging = checked_staging(simulator, task, situation, conditions, seed)
    started_s = time.time()
    simulator.reset(staging.scene)
    judge = task.judge(staging.situation)
    policy.begin(situation, seed)
    names = tuple(simulator.bodies().places)
    images, crops, actions, targets, joints, poses, outputs = [], [], [], [], [], [], []
    focus = float(task.start[FOCUS])
    pfc = policy.pfc if isinstance(policy, ObservablePolicy) else lambda: None
    for step, phase in enumerate(task.phases):
        if step == staging.changed_at and isinstance(policy, InformedPolicy):
            policy.change(staging.situation)
        crops.append(crop_of_focus(focus))
        seen = simulator.observe(crops[-1])
        image = staging.picture(step, seen.image)
        action = _with_task_attention(task, clip_action(policy.step(image)))
        bodies = simulator.bodies()
        poses.append(bodies.rows)
        if on_step is not None:
            on_step(
                LiveStep(
                    step=step,
                    phase=task.phase_names[phase],
                    image=image,
                    joints_deg=seen.joints_deg,
                    action=action,
                    bodies=bodies,
                    scene=staging.scene,
                    crop=crops[-1],
                    pfc=pfc(),
                )
            )
        report = simulator.step(targets_of_action(action))
        judge.watch(report, simulator.joints_deg(), simulator.bodies())
        images.append(image)
        actions.append(action)
        targets.append(
            action if policy.target is None else _with_task_attention(task, policy.target)
        )
        joints.append(seen.joints_deg)
        if policy.outputs is not None:
            outputs.append(policy.outputs)
        focus = float(action[FOCUS])
    return Episode(
        id=uuid.uuid4().hex,
        kind=kind,
        task=task.name,
        situation=dict(situation),
        seed=seed,
        actor=actor,
        backend=simulator.name,
        policy=policy.name,
        policy_version=policy.version,
        config_digest=config_digest,
        images=np.stack(images),
        actions=np.asarray(actions, dtype=np.float32),
        targets=np.asarray(targets, dtype=np.float32),
        joints_deg=np.asarray(joints, dtype=np.float32),
        phase_names=task.phase_names,
        phases=task.phases.copy(),
        body_names=names,
        body_poses=np.stack(poses).astype(np.float32),
        outcome=judge.outcome(),
        outputs=np.asarray(outputs, dtype=np.float32) if outputs else None,
        control_period_s=simulator.control_period_s,
        started_s=started_s,
        view=view_of(staging.scene, crops),
        conditions=conditions,
    )


def _with_task_attention(task: Task, action: Array) -> Array:
    """Return the action (11,); if the task fixes attention, with neck and focus of the start."""
    return action if task.attention == "active" else with_attention_of(task.start, action)
