"""`vmdnn bench`: measure speed on this machine."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from actors.bench import bench_backends
from learner.bench.bptt import bench_bptt
from proto.config import Config
from services.arguments.common import add_config, config_of, positive
from services.bus_bench import bench_bus


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    subjects = parser.add_subparsers(dest="subject", metavar="SUBJECT", required=True)
    actor = subjects.add_parser(
        "actor",
        help="physics, rendering, the network's step, and the actor's whole loop, in each installed"
        " simulator",
    )
    bptt = subjects.add_parser(
        "bptt", help="one epoch of coupled training, compared with other implementations"
    )
    bptt.add_argument("--batch", type=positive, default=45, help="number of sequences")
    bptt.add_argument("--steps", type=positive, default=124, help="length of the sequences")
    bptt.add_argument(
        "--threads",
        type=positive,
        default=len(os.sched_getaffinity(0)),
        help="threads of each implementation",
    )
    bus = subjects.add_parser(
        "bus",
        help="episodes a second through hub, evaluator and learner with up to 128 light actors,"
        " beside the same bytes without vmdnn",
    )
    for subject in (actor, bptt, bus):
        add_config(subject)
        subject.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Measure and print the speeds."""
    config = config_of(arguments)
    if arguments.subject == "actor":
        return _run_actor(config, as_json=arguments.json)
    if arguments.subject == "bus":
        return _run_bus(config, as_json=arguments.json)
    measured = bench_bptt(
        config,
        batch=arguments.batch,
        steps=arguments.steps,
        threads=arguments.threads,
    )
    speed = _rounded(asdict(measured))
    if arguments.json:
        print(json.dumps(speed))
    else:
        for name, value in speed.items():
            print(f"{name:12} {value}")
    return 0


def _run_actor(config: Config, *, as_json: bool) -> int:
    """Measure all installed simulators, and print them beside each other."""
    measured, problems = bench_backends(config)
    speeds = [_rounded(asdict(speed)) for speed in measured]
    for name, problem in problems.items():
        print(f"{name} is left out: {problem}", file=sys.stderr)
    if as_json:
        chosen, *others = speeds
        print(json.dumps({**chosen, "others": others}))
    else:
        print(f"{'machine':17} {speeds[0].pop('machine')}")
        for name in speeds[0]:
            print(f"{name:17}", *(f"{speed[name]!s:10}" for speed in speeds))
    return 0


def _run_bus(config: Config, *, as_json: bool) -> int:
    speed = _rounded(asdict(bench_bus(config)))
    if as_json:
        print(json.dumps(speed))
        return 0
    for name, value in speed.items():
        if isinstance(value, list):
            print(f"{name}:")
            for number, flow in enumerate(value):
                if number == 0:
                    print(" ", *(f"{key:>14}" for key in flow))
                print(" ", *(f"{each:14.6g}" for each in flow.values()))
        else:
            print(f"{name:17} {value}")
    return 0


def _rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _round(value) for name, value in values.items()}


def _round(value: object) -> object:
    if isinstance(value, Mapping):
        return _rounded(value)
    if isinstance(value, list | tuple):
        return [_round(each) for each in value]
    return round(value, 4) if isinstance(value, float) else value
