# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Present a command's results: facts, tables and figures, as text, JSON or HTML."""

from pkm_twin.report.report import Column, Fact, Report, Table, Verdict, format_number, make_judged_fact, to_json_data

__all__ = ["Column", "Fact", "Report", "Table", "Verdict", "format_number", "make_judged_fact", "to_json_data"]
