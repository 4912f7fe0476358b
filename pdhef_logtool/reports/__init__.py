"""Pages of a finished run: whole files that need no network, drawn from the run's own outputs.

Each page is a template and a module that fills it. It must not read logs or run estimators: it uses stored values only.
"""
