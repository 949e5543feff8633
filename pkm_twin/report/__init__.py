# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a command answers: facts, tables and figures, for the terminal, scripts and the browser."""

from pkm_twin.report.report import Column, Fact, Report, Table, Verdict, judged, number, plain

__all__ = ["Column", "Fact", "Report", "Table", "Verdict", "judged", "number", "plain"]
