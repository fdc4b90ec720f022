"""The registration of `photogram.icgn`, batched over subsets and frames in torch, for a GPU.

Kornia has no part in this: its samplers are bilinear or bicubic, which err by 1e-2 of full scale on speckle where the
quintic B-spline errs by 1e-5.
"""

from photogram.icgn_torch.frames import TorchSplines, prefilter, spline_frames
from photogram.icgn_torch.register import TorchReference, register_frames, torch_reference
from photogram.icgn_torch.stream import follow_frames

__all__ = [
    "TorchReference",
    "TorchSplines",
    "follow_frames",
    "prefilter",
    "register_frames",
    "spline_frames",
    "torch_reference",
]
