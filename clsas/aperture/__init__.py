"""The aperture: which few virtual channels stand for many channels."""
