"""Target views → stereo rig with covariance."""
