"""Manifests drafted from what lies in a folder (`shakercal init`)."""
