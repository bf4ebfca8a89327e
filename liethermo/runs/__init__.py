"""Runs: ``integrate``, ``ensemble`` and ``flow``, the steps that they take and the states that they save."""
