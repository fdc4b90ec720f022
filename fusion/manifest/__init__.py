"""recording.toml and rig.toml as checked, typed values: the contract is `docs/recording-format.md`.

Attributes are named as the TOML keys. Paths are resolved, directions are unit vectors, a single number given for the
uncertainty of a vector stands in each element, images and points carry the exposure of their stereo pair.
"""

from fusion.manifest.load import RECORDING_NAME, Manifest, find_recordings, for_kinds, load_manifest
from fusion.manifest.recording import ChannelEntry, Daq, Excitation, Frames, Images, PointFiles, RecordingFile, Take
from fusion.manifest.rig import Administration, Environment, Load, Part, Rig, Sensor, Stereo
from fusion.manifest.values import PULSE

__all__ = [
    "PULSE",
    "RECORDING_NAME",
    "Administration",
    "ChannelEntry",
    "Daq",
    "Environment",
    "Excitation",
    "Frames",
    "Images",
    "Load",
    "Manifest",
    "Part",
    "PointFiles",
    "RecordingFile",
    "Rig",
    "Sensor",
    "Stereo",
    "Take",
    "find_recordings",
    "for_kinds",
    "load_manifest",
]
