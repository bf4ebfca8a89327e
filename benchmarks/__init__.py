"""Benchmarks of the library against C, SciPy, diffrax and heyoka, with equal work in one run.

``python -m benchmarks`` runs them and ``make bench`` writes the page of the documentation from the results. A
measurement is a module of :mod:`benchmarks.measurements` with one function, ``run(quick)``, that returns a report.
"""
