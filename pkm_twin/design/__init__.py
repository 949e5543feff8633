# SPDX-License-Identifier: Apache-2.0
"""The machine as a function of its file's numbers: variants and what is asked of many at once."""
