# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Numbers of a machine from recordings, and whether the recordings fit the machine at all.

:mod:`~pkm_twin.identification.fit` fits masses, friction and rotors to efforts,
:mod:`~pkm_twin.identification.deflections` compliances to deflections,
:mod:`~pkm_twin.identification.calibration` geometry and offsets to poses, or to any of the
:mod:`~pkm_twin.identification.measurements` of them.
:mod:`~pkm_twin.identification.judge` judges a fit by its residual,
:mod:`~pkm_twin.identification.hypotheses` says what explains a recording that contradicts the file,
:mod:`~pkm_twin.identification.check` judges it against the file.
"""
