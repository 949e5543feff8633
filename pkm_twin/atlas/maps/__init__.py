# SPDX-License-Identifier: Apache-2.0
"""Maps of one number over the workspace: compliance, energy, payload, acceleration and others.

A quantity is a function of joint positions (``quantity.py``); grid, validity, worst pose, pictures,
page and command are the same for all.
"""
