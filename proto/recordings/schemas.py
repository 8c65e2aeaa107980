"""Protobuf schemas of a recording: Foxglove's schemas, and `Step` and `States` defined here.

A file is read by the numbers of the fields, so that their names may change.
"""

from __future__ import annotations

from typing import Final

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import message_factory
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import Default
from google.protobuf.message import Message

from proto.body import ACTION_NAMES, FOCUS, GRASP

__all__ = [
    "ACTION_FIELDS",
    "CameraCalibration",
    "CompressedImage",
    "FrameTransforms",
    "JointStates",
    "Log",
    "Message",
    "SceneUpdate",
    "States",
    "Step",
    "describe",
]

ACTION_FIELDS: Final = tuple(
    name if number in (GRASP, FOCUS) else f"{name}_deg" for number, name in enumerate(ACTION_NAMES)
)
"""Fields of an action, in its order; the name of an angle ends with its unit."""


def _field(number: int, name: str, kind: int, message: str | None = None) -> FieldDescriptorProto:
    return FieldDescriptorProto(
        number=number,
        name=name,
        type=kind,
        type_name=message,
        label=FieldDescriptorProto.LABEL_OPTIONAL,
    )


def _step_file() -> FileDescriptorProto:
    """Describe `Step`: the action of one control step, its target and the policy's outputs."""
    action = DescriptorProto(
        name="Action",
        field=[
            _field(number, name, FieldDescriptorProto.TYPE_FLOAT)
            for number, name in enumerate(ACTION_FIELDS, 1)
        ],
    )
    outputs = _field(5, "outputs", FieldDescriptorProto.TYPE_FLOAT)
    outputs.label = FieldDescriptorProto.LABEL_REPEATED
    step = DescriptorProto(
        name="Step",
        field=[
            _field(1, "step", FieldDescriptorProto.TYPE_UINT32),
            _field(2, "phase", FieldDescriptorProto.TYPE_UINT32),
            _field(3, "action", FieldDescriptorProto.TYPE_MESSAGE, ".vmdnn.Action"),
            _field(4, "target", FieldDescriptorProto.TYPE_MESSAGE, ".vmdnn.Action"),
            outputs,
            _field(6, "phase_name", FieldDescriptorProto.TYPE_STRING),
        ],
    )
    return FileDescriptorProto(
        name="vmdnn/step.proto", package="vmdnn", syntax="proto3", message_type=[action, step]
    )


def _states_file() -> FileDescriptorProto:
    """Describe `States`: the activity of a network's subnets in one control step."""
    activity = _field(2, "activity", FieldDescriptorProto.TYPE_FLOAT)
    activity.label = FieldDescriptorProto.LABEL_REPEATED
    subnet = DescriptorProto(
        name="Subnet", field=[_field(1, "name", FieldDescriptorProto.TYPE_STRING), activity]
    )
    subnets = _field(1, "subnets", FieldDescriptorProto.TYPE_MESSAGE, ".vmdnn.Subnet")
    subnets.label = FieldDescriptorProto.LABEL_REPEATED
    return FileDescriptorProto(
        name="vmdnn/states.proto",
        package="vmdnn",
        syntax="proto3",
        message_type=[subnet, DescriptorProto(name="States", field=[subnets])],
    )


Default().Add(_step_file())
Default().Add(_states_file())
Step: Final = message_factory.GetMessageClass(Default().FindMessageTypeByName("vmdnn.Step"))
"""One control step: `step`, `action` and `target` (units of `proto.body`), `outputs`, `phase` (its
number, from 1) and `phase_name`."""
States: Final = message_factory.GetMessageClass(Default().FindMessageTypeByName("vmdnn.States"))
"""One control step of a network: `subnets`, each with its `name` and `activity`."""


def describe(message: type[Message]) -> bytes:
    """Serialize the schema of a message class for MCAP: its file and all files that it imports.

    Returns:
        A serialized FileDescriptorSet; each file comes after those that it imports.
    """
    files: dict[str, FileDescriptorProto] = {}

    def collect(file: FileDescriptor) -> None:
        if file.name not in files:
            for dependency in file.dependencies:
                collect(dependency)
            description = FileDescriptorProto()
            file.CopyToProto(description)
            files[file.name] = description

    collect(message.DESCRIPTOR.file)
    return bytes(FileDescriptorSet(file=files.values()).SerializeToString())
