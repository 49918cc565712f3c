"""Online neural RGB-D SLAM, as jitted pure functions and as a program.

The names below are loaded when first used, so that importing the package starts no device and loads neither
images nor meshes:

    import mipsjax
    cfg = mipsjax.preset("default")
    sequence = mipsjax.open_sequence("synth:room")
    state, info = mipsjax.start(sequence[0], sequence.intrinsics, cfg)
    state, info = mipsjax.step(state, sequence[1], cfg)
    state = mipsjax.finish(state, cfg)
    mesh = mipsjax.reconstruct_mesh(state, cfg)
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mipsjax.config.options import validate as validate
    from mipsjax.config.presets import PRESETS as PRESETS
    from mipsjax.config.presets import preset as preset
    from mipsjax.config.sections import Config as Config
    from mipsjax.core.blend import Blended as Blended
    from mipsjax.core.blend import add as blend  # noqa: F401
    from mipsjax.core.blend import start as blend_of_none  # noqa: F401
    from mipsjax.core.camera import Intrinsics as Intrinsics
    from mipsjax.core.draws import Frames as Frames
    from mipsjax.core.field import color as color
    from mipsjax.core.field import init as init
    from mipsjax.core.field import tsdf as tsdf
    from mipsjax.core.mapping import Learned as Learned
    from mipsjax.core.mapping import create as create
    from mipsjax.core.mapping import refine as refine
    from mipsjax.core.particles import fitness as fitness
    from mipsjax.core.tracking import track as track
    from mipsjax.core.views import Views as Views
    from mipsjax.data.open import open_sequence as open_sequence
    from mipsjax.data.sequence import Frame as Frame
    from mipsjax.data.sequence import Sequence as Sequence
    from mipsjax.errors import ConfigError as ConfigError
    from mipsjax.errors import InputError as InputError
    from mipsjax.errors import MipsjaxError as MipsjaxError
    from mipsjax.errors import OutputError as OutputError
    from mipsjax.errors import TrackingLostError as TrackingLostError
    from mipsjax.mesh.reconstruct import reconstruct as reconstruct_mesh  # noqa: F401
    from mipsjax.slam.finish import finish as finish
    from mipsjax.slam.info import FrameInfo as FrameInfo
    from mipsjax.slam.localise import continued as continued
    from mipsjax.slam.localise import localise as localise
    from mipsjax.slam.step import start as start
    from mipsjax.slam.step import step as step
    from mipsjax.submaps.saved import load as load
    from mipsjax.submaps.saved import save as save
    from mipsjax.submaps.state import SlamState as SlamState
    from mipsjax.submaps.state import Status as Status
    from mipsjax.submaps.state import Submap as Submap
    from mipsjax.submaps.state import trajectory as trajectory

    __version__: str

# `reconstruct_mesh` is not named after its function, since a package attribute cannot be both that function
# and the module it is in.
_PLACES = {
    "PRESETS": "config.presets:PRESETS",
    "Blended": "core.blend:Blended",
    "Config": "config.sections:Config",
    "ConfigError": "errors:ConfigError",
    "FrameInfo": "slam.info:FrameInfo",
    "Frame": "data.sequence:Frame",
    "Frames": "core.draws:Frames",
    "InputError": "errors:InputError",
    "Learned": "core.mapping:Learned",
    "Intrinsics": "core.camera:Intrinsics",
    "MipsjaxError": "errors:MipsjaxError",
    "OutputError": "errors:OutputError",
    "Sequence": "data.sequence:Sequence",
    "SlamState": "submaps.state:SlamState",
    "Status": "submaps.state:Status",
    "Submap": "submaps.state:Submap",
    "TrackingLostError": "errors:TrackingLostError",
    "Views": "core.views:Views",
    "blend": "core.blend:add",
    "blend_of_none": "core.blend:start",
    "color": "core.field:color",
    "continued": "slam.localise:continued",
    "create": "core.mapping:create",
    "tsdf": "core.field:tsdf",
    "fitness": "core.particles:fitness",
    "init": "core.field:init",
    "load": "submaps.saved:load",
    "localise": "slam.localise:localise",
    "open_sequence": "data.open:open_sequence",
    "preset": "config.presets:preset",
    "reconstruct_mesh": "mesh.reconstruct:reconstruct",
    "refine": "core.mapping:refine",
    "finish": "slam.finish:finish",
    "save": "submaps.saved:save",
    "start": "slam.step:start",
    "step": "slam.step:step",
    "track": "core.tracking:track",
    "trajectory": "submaps.state:trajectory",
    "validate": "config.options:validate",
}


def _is_door() -> bool:
    """Whether Python is on the way to a program of this package, as with `python -m mipsjax.run`."""
    behind = zip(sys.orig_argv, sys.orig_argv[1:], strict=False)
    ours = any(option == "-m" and name.startswith("mipsjax.") for option, name in behind)
    # Python puts this there until it has found the module
    return ours and sys.argv[:1] == ["-m"]


if _is_door():
    # What is imported below and later takes seconds, in which Ctrl-C would be swallowed or print a traceback
    import_module("mipsjax.app.signals").end_at_once()


def _version(package: str) -> str:
    from importlib.metadata import version  # takes longer than all else here

    return version(package)


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

_check_jaxlib(_version("jaxlib"), os.environ.get("XLA_FLAGS", ""))


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version("mipsjax")
    if name not in _PLACES:
        raise AttributeError(f"module 'mipsjax' has no attribute '{name}'")
    module, attribute = _PLACES[name].split(":")
    value = getattr(import_module(f"mipsjax.{module}"), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES, "__version__"])
