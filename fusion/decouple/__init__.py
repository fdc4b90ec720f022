"""The command `shakercal decouple`: a common model of all outputs, and the filter against cross-talk."""
