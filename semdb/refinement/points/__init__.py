"""Keyframes of one map that improve each other's 3D points. Arrays in, arrays out; nothing here knows the database."""
