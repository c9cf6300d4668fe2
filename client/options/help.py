"""Help of the commands with many options: in groups, and those that people need first; `--help-all` shows all."""

from __future__ import annotations

from typing import Any

import typer.core

ALL = "--help-all"
GROUPS: dict[str, tuple[str, ...]] = {
    "Source": ("frames", "poses", "volume", "voxel", "exposure", "up", "smooth_depth"),
    "Output": (
        *("out", "overwrite", "video", "rerun", "scene", "mesh", "panorama_out", "light_at", "record", "view"),
        *("frame", "open_page"),
    ),
    "Virtual objects": ("object", "edges", "tone_mapping"),
    "Quality and time": (
        *("preset", "budget_ms", "max_light_error", "device", "rays", "stride", "interleave", "upsampling"),
        *("visibility_state", "auxiliary_views", "ray_length", "plan", "cache"),
    ),
    "Light": (
        *("light", "panorama", "bands", "albedo", "indirect", "lamps", "robustness", "denoise", "denoise_iterations"),
        *("as_thesis",),
    ),
    "Server and link": (
        *("server", "token", "realtime", "lossless", "adapt", "color", "answer", "depth_noise", "tls_fingerprint"),
        *("tls_ca",),
    ),
    "Room": ("room", "room_key", "room_from_world", "marker"),
    "Address and access": (
        *("host", "port", "token_file", "insecure", "allow_origin", "tls", "tls_cert", "tls_key", "trusted_proxy"),
    ),
    "Limits and data": (
        *("sessions", "sessions_per_address", "volume_memory", "objects", "data", "data_gib", "data_days", "restart"),
        "log",
    ),
}
"""Options of all these commands, in the order in which they are shown."""
FIRST = {
    *("frames", "poses", "up", "out", "overwrite", "video", "mesh", "object", "preset", "budget_ms", "device"),
    *("light_at", "panorama_out", "server", "realtime", "lossless", "room", "frame", "open_page"),
    *("host", "port", "tls", "objects", "data"),
}
"""Options that `--help` shows; `--help-all` shows the others too."""


class GroupedHelp(typer.core.TyperCommand):
    """A command whose options are shown in GROUPS."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write SOURCE, then the options by group."""
        wants_all = bool((ctx.find_root().obj or {}).get(ALL))
        parameters = {parameter.name: parameter for parameter in self.get_params(ctx)}
        shown = {
            name: record
            for name, parameter in parameters.items()
            if (wants_all or name in FIRST or parameter.required)
            and name != "help"
            and (record := parameter.get_help_record(ctx)) is not None
        }
        arguments = [name for name, parameter in parameters.items() if parameter.param_type_name == "argument"]
        grouped = {name for names in GROUPS.values() for name in names}
        rest = tuple(name for name in parameters if name not in grouped and name not in arguments)
        for title, names in {"Arguments": tuple(arguments), **GROUPS, "Others": rest}.items():
            rows = [shown[name] for name in names if name in shown]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples as they are, and where the other options are shown."""
        if self.epilog:
            with formatter.section("Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"  {line}\n")
        if not (ctx.find_root().obj or {}).get(ALL):
            formatter.write(f"\nprobeless {self.name} {ALL} shows every option.\n")
