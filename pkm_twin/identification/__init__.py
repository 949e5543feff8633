# SPDX-License-Identifier: Apache-2.0
"""Numbers of a machine from recordings, and whether the recordings fit the machine at all.

:mod:`~pkm_twin.identification.verdict` judges a fit by its residual,
:mod:`~pkm_twin.identification.plausible` judges a recording before it is fitted,
:mod:`~pkm_twin.identification.robust` weighs measured poses.

May import: numpy, scipy, pkm_twin's core, the standard library. Nothing of the applications.
"""
