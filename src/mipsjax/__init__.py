"""Online neural RGB-D SLAM, as jitted pure functions and as a program.

The names below are loaded when first used, so that importing the package starts no device and loads neither
images nor meshes:

    import mipsjax
    cfg = mipsjax.preset("default")
    sequence = mipsjax.open_sequence("synth:room")
    state = mipsjax.start(sequence[0], sequence.intrinsics, cfg)
    state = mipsjax.step(state, sequence[1], cfg)
    state = mipsjax.finish(state, cfg)
    mesh = mipsjax.reconstruct_mesh(state, cfg)
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mipsjax.config import Config as Config
    from mipsjax.core.camera import Intrinsics as Intrinsics
    from mipsjax.core.mapping import Learned as Learned
    from mipsjax.core.mapping import refine as refine
    from mipsjax.core.particles import fitness as fitness
    from mipsjax.core.tracking import track as track
    from mipsjax.data.open import open_sequence as open_sequence
    from mipsjax.data.sequence import Frame as Frame
    from mipsjax.data.sequence import Sequence as Sequence
    from mipsjax.errors import ConfigError as ConfigError
    from mipsjax.errors import InputError as InputError
    from mipsjax.errors import MipsjaxError as MipsjaxError
    from mipsjax.errors import OutputError as OutputError
    from mipsjax.errors import TrackingLostError as TrackingLostError
    from mipsjax.final import finish as finish
    from mipsjax.options import validate as validate
    from mipsjax.policy import Status as Status
    from mipsjax.presets import PRESETS as PRESETS
    from mipsjax.presets import preset as preset
    from mipsjax.reconstruct import reconstruct as reconstruct_mesh  # noqa: F401
    from mipsjax.slam import start as start
    from mipsjax.slam import step as step
    from mipsjax.state import SlamState as SlamState
    from mipsjax.state import Submap as Submap
    from mipsjax.state import trajectory as trajectory

    __version__: str

# `reconstruct_mesh` is not named after its function, since a package attribute cannot be both that function
# and the module it is in.
_PLACES = {
    "PRESETS": "presets:PRESETS",
    "Config": "config:Config",
    "ConfigError": "errors:ConfigError",
    "Frame": "data.sequence:Frame",
    "InputError": "errors:InputError",
    "Learned": "core.mapping:Learned",
    "Intrinsics": "core.camera:Intrinsics",
    "MipsjaxError": "errors:MipsjaxError",
    "OutputError": "errors:OutputError",
    "Sequence": "data.sequence:Sequence",
    "SlamState": "state:SlamState",
    "Status": "policy:Status",
    "Submap": "state:Submap",
    "TrackingLostError": "errors:TrackingLostError",
    "fitness": "core.particles:fitness",
    "open_sequence": "data.open:open_sequence",
    "preset": "presets:preset",
    "reconstruct_mesh": "reconstruct:reconstruct",
    "refine": "core.mapping:refine",
    "finish": "final:finish",
    "start": "slam:start",
    "step": "slam:step",
    "track": "core.tracking:track",
    "trajectory": "state:trajectory",
    "validate": "options:validate",
}


# Their fusions with the YNN library read freed memory on CPUs (jax issue 39257): a pose comes out wrong, NaN, or
# the process dies. The requirements exclude them; this is for environments put together otherwise.
_BROKEN_JAXLIB = ("0.10.2", "0.11.0")
_WITHOUT_YNN = "--xla_cpu_experimental_ynn_fusion_type="


def _check_jaxlib(found: str, flags: str) -> None:
    """Raises ImportError where this jaxlib computes wrong derivatives."""
    if found in _BROKEN_JAXLIB and _WITHOUT_YNN not in flags.split():
        raise ImportError(
            f"jaxlib {found} computes wrong results on CPUs (jax issue 39257): install another version, "
            f"or set XLA_FLAGS={_WITHOUT_YNN}"
        )


# jaxlib says of each program that it reads from its own compilation cache, in kilobytes and as an error, that it may
# not fit the processor, although it does. Errors that matter are raised.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

_check_jaxlib(version("jaxlib"), os.environ.get("XLA_FLAGS", ""))


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("mipsjax")
    if name not in _PLACES:
        raise AttributeError(f"module 'mipsjax' has no attribute '{name}'")
    module, attribute = _PLACES[name].split(":")
    value = getattr(import_module(f"mipsjax.{module}"), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES, "__version__"])
