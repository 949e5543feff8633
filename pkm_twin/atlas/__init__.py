# SPDX-License-Identifier: Apache-2.0
"""Atlases: one quantity over a whole grid of poses, swept in chunks, stored as NetCDF, drawn.

A kind of atlas is a package: its :class:`~pkm_twin.atlas.sweep.Sweep`, its figures and its page.
``run.py`` computes a sweep's chunks on this machine or on a Dask cluster, ``store.py`` keeps them
and joins them into one file; ``figures.py`` and ``pages.py`` are what all kinds draw it with.
xarray, h5netcdf, plotly and dask are extras, imported on first use.
"""
