"""Stereo calibration: from target views or files of other programs to a `StereoRig` with covariance."""
