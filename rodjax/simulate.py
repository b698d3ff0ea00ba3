"""Rollouts: over given steps by `lax.scan`, or with the step chosen by the local error."""

