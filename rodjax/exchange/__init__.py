"""Runs in the forms of other tools, shapes and motions from theirs."""
