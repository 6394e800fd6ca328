"""Options of ``compare`` → the systems to compare, and what they have in common."""

import argparse
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidargrit.evaluation.benchmark import Benchmark

DEFAULTS: dict[str, Any] = {
    "against": "simulated:256:test",
    "count": 256,
    "protocol": "exact",
    "metrics": [],
    "flops": 0.0,
    "set": [],
}
"""Settings that all systems share where the user gives none; a table that is extended keeps its own."""


def wanted(options: argparse.Namespace) -> "tuple[list[str], Benchmark]":
    """Return the systems to compare, and what they have in common."""
    from lidargrit.core.errors import ConfigError
    from lidargrit.evaluation.benchmark import Benchmark
    from lidargrit.evaluation.comparison import EvalConfig
    from lidargrit.evaluation.table_folder import read_table

    given = {name: value for name in DEFAULTS if (value := getattr(options, name)) not in (None, [])}
    if options.add:
        if options.systems or given:
            own = [f"--{name}" if name != "count" else "-n" for name in given]
            raise ConfigError(
                f"--add with {'systems before it' if options.systems else f'settings of its own ({own[0]})'}",
                "--add SYSTEM ... alone: all else is as in the table",
                "leave them out, or begin a table in another folder",
            )
        systems, benchmark = read_table(options.out)
        return [*systems, *(system for system in options.add if system not in systems)], benchmark
    chosen = DEFAULTS | given
    return options.systems, Benchmark(
        reference=chosen["against"],
        num_samples=chosen["count"],
        settings=EvalConfig(protocol=chosen["protocol"], metrics=tuple(chosen["metrics"])),
        preset_settings=tuple(chosen["set"]),
        flops=chosen["flops"],
    )
