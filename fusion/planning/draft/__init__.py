"""Manifests drafted from the files of a folder (`shakercal init`)."""
