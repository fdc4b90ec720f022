"""The command `shakercal decouple`: outputs of several loads to a common model and the filter that undoes cross-talk."""
