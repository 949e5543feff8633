# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Workspace maps: one quantity over all poses, its worst pose, and planes through it.

A kind is one file in ``kinds/``. ``sweep.py`` has the grid and the planes, ``search.py`` the worst
pose; ``run.py`` computes chunks on this machine or on a Dask cluster, ``store.py`` keeps them and
joins them into one file; ``figures.py`` and ``page.py`` draw it. xarray, h5netcdf, plotly and dask
are extras, imported on first use.
"""
