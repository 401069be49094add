"""``pea emulate``: emulate a device, to rehearse without hardware.

The first line on stdout is the address for a driver, the second that of the control channel
(`pea_drivers.emulator`); the last, at the end, is what the device has felt, as JSON.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from pea_cli.options import path_of, whole
from pea_core.params import ParameterError, nearest

PATIENCE = 3600.0
"""Seconds between two looks at nothing, for a signal to end them."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    emulates = commands.add_parser("emulate", help="emulate a device, to rehearse without hardware")
    emulates.add_argument("device", metavar="DEVICE", help="a driver; `pea list` names them")
    emulates.add_argument("--rig", metavar="NAME", help="rig in config/rigs/, or path of a file")
    ways = emulates.add_mutually_exclusive_group()
    ways.add_argument(
        "--port", metavar="N", help="TCP port on 127.0.0.1, 0: any free one (default: the rig's)"
    )
    ways.add_argument("--pty", action="store_true", help="a serial line in place of TCP")
    emulates.add_argument(
        "--fault",
        metavar="NAME[=VALUE][@SECONDS]",
        action="append",
        default=[],
        dest="faults",
        help="refuse, drop, mute, pull, truncate, garbage, delay=S, drip=S, babble, lose=PERCENT, "
        "error=CODE, stuck, jump=UM, saturate=V; @SECONDS counts from the first command; may be "
        "repeated",
    )
    emulates.add_argument(
        "--set",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        dest="sets",
        help="change a parameter of the emulator; may be repeated",
    )
    emulates.add_argument(
        "--log",
        metavar="FILE",
        type=path_of,
        help="write the voltages at the emulated stage, as JSON",
    )


def _port(arguments: argparse.Namespace, address: str, emulator: Any) -> int | None:
    """Port, None for a pty; an emulator whose address is of its own kind has a ``port_of``."""
    from pea_drivers import transport

    if arguments.pty:
        return None
    if arguments.port is None and hasattr(emulator, "port_of"):
        port: int = emulator.port_of(address)
        return port
    if arguments.port is None:
        kind, place, _ = transport.parse(address)
        return place[1] if kind == "tcp" else None
    return whole("--port", arguments.port, 0, 65535)


def _plants(values: dict[str, Any], device: str) -> tuple[Any, ...]:
    """Parameters of the stage behind the device, of each axis.

    Raises
    ------
    ParameterError
        They do not go together, or the device cannot couple its stages so.
    """
    from pea_core.config import resolve_axes
    from pea_plant import drivers
    from pea_plant.plant import Params

    resolved = resolve_axes("plant", Params, [values, {"driver.type": device}])
    plants = tuple(own.params for own in resolved)
    if len(plants) > 1:
        drivers.together(resolved[0].node.axes, plants)
    if plants[0].stage.modes_K:
        raise ParameterError(
            "plant.stage.modes_K: an emulated device does not couple its stages by modes; give "
            "plant.stage.cross_talk"
        )
    return plants


def _emulator(device: str) -> Any:
    """The module that emulates a device.

    Raises
    ------
    ParameterError
        There is none, or it needs a package that is not installed.
    """
    import importlib

    from pea_plant import drivers

    name = f"{drivers.MODULES[device].__name__}.emulator"
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        has = error.name != name
        lacks = f"its emulator needs the Python package {error.name}" if has else "has no emulator"
        raise ParameterError(f"device {device!r}: {lacks}") from None


def _emulate(arguments: argparse.Namespace) -> int:
    import threading

    from pea_core.config import parse
    from pea_core.params import build
    from pea_drivers.faults import fault
    from pea_engine.compiled import WORTH, wanted
    from pea_experiment import rig
    from pea_plant import drivers

    if arguments.device not in drivers.MODULES:
        advice = nearest(arguments.device, drivers.MODULES)
        raise ParameterError(f"unknown device {arguments.device!r}: {advice}")
    values = rig.read(arguments.rig) if arguments.rig else {"plant": {}, rig.EMULATOR: {}}
    of_rig = values["plant"].get("driver.type", arguments.device)
    if of_rig != arguments.device:
        raise ParameterError(
            f"rig {arguments.rig!r}: its driver is {of_rig}, not {arguments.device}; "
            f"write pea emulate {of_rig} --rig {arguments.rig}"
        )
    plants = _plants(values["plant"], arguments.device)
    emulator = _emulator(arguments.device)
    own = {}
    for text in arguments.sets:
        name, equals, value = text.partition("=")
        if not equals:
            raise ParameterError(f"--set {text!r}: write NAME=VALUE")
        own[name] = parse(value)
    params = build(emulator.Params, {**values[rig.EMULATOR], **own}, f"{rig.EMULATOR}.")
    for text in arguments.faults:
        fault(text)
    if arguments.log and arguments.log.is_dir():
        raise ParameterError(f"--log {arguments.log}: is a directory; give a file")
    port = _port(arguments, plants[0].driver.address, emulator)
    stages = plants[0] if len(plants) == 1 else plants  # one device for all axes
    with emulator.make(stages, params, port, compiled=wanted(WORTH)) as device:
        for text in arguments.faults:
            device.inject(text)
        print(device.address, flush=True)
        print(device.control(), flush=True)
        try:
            while True:
                threading.Event().wait(PATIENCE)
        except KeyboardInterrupt:
            pass
        told = json.dumps(device.told())
    if arguments.log:
        arguments.log.write_text(told + "\n", encoding="utf-8")
    print(told, flush=True)
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"emulate": _emulate}
