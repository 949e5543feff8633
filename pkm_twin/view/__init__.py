# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin view``: a robot in a browser. Pure parts, and the page that viser serves.

``model`` (sliders in, numbers out), ``scene`` (numbers to shapes), ``timeline`` (a bag), ``live``
(messages) and ``texts`` know nothing of viser; ``page`` does.
"""
