"""Recordings to rows: which frames become keyframes, the plan, the work on it in stages, messages to a fleet."""
