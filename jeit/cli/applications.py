"""Commands of the applications above the core, by name: they are imported when they are called."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

from jeit.cli.options import NETWORK

# Each command and the module that has it, which is imported when the command is called.
COMMANDS = {
    "demo": "jeit.cli.commands.demo",
    "reconstruct": "jeit.cli.commands.reconstruct",
    "view": "jeit.cli.commands.view",
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


def check_method(method: str | None, others: Iterable[str]) -> None:
    """Raise `ValueError` for a `--method` that is neither among `others` nor the network's."""
    from jeit.arguments import check_name

    if method is not None:
        check_name("--method", method, (*others, NETWORK))


def image_by_network(*arguments: Any, **options: Any) -> None:
    """Image frames by a network: `jeit.touch.commands.networks.image_by_network`."""
    importlib.import_module("jeit.touch.commands.networks").image_by_network(*arguments, **options)
