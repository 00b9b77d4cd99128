"""Table of all commands of `jeit` and their modules, which are imported only when a command is called."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

from jeit.cli.options import NETWORK_METHOD

# Module of each command, by name of the command.
COMMANDS = {
    "demo": "jeit.cli.commands.demo",
    "describe": "jeit.cli.commands.describe",
    "reconstruct": "jeit.cli.commands.reconstruct",
    "view": "jeit.cli.commands.view",
    "live": "jeit.live.commands.live",
    "stream": "jeit.cli.commands.stream",
    "series": "jeit.cli.commands.series",
    "choose": "jeit.cli.commands.choose",
    "info": "jeit.cli.commands.info",
    "calibrate-microphones": "jeit.acoustic.commands.calibrate_microphones",
    "locate": "jeit.acoustic.commands.locate",
    "listen": "jeit.touch.commands.listen",
    "layout": "jeit.design.commands.layout",
    "study": "jeit.design.commands.study",
    "touch": "jeit.touch.commands.touch",
    "learn": "jeit.touch.commands.networks",
}


def check_method(method: str | None, other_methods: Iterable[str]) -> None:
    """Check the option `--method`. Raises `ValueError` unless the method is "network" or among `other_methods`."""
    from jeit.arguments import check_name

    if method is not None:
        check_name("--method", method, (*other_methods, NETWORK_METHOD))


def image_by_network(*arguments: Any, **options: Any) -> None:
    """Image frames by a network; see `jeit.touch.commands.networks.image_by_network`."""
    importlib.import_module("jeit.touch.commands.networks").image_by_network(*arguments, **options)
