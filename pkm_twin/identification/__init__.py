# SPDX-License-Identifier: Apache-2.0
"""Numbers of a machine from recordings, and whether the recordings fit the machine at all.

:mod:`~pkm_twin.identification.fit` fits masses, friction and rotors to efforts,
:mod:`~pkm_twin.identification.deflections` compliances to deflections,
:mod:`~pkm_twin.identification.calibration` geometry and offsets to poses, or to any of the
:mod:`~pkm_twin.identification.measurements` of them, which :mod:`~pkm_twin.identification.plan`
chooses;
:mod:`~pkm_twin.identification.excitation` designs motions that identify.
:mod:`~pkm_twin.identification.judge` judges a fit by its residual,
:mod:`~pkm_twin.identification.plausible` judges a recording before it is fitted,
:mod:`~pkm_twin.identification.noise` has noise and robust weights.
"""
