/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
#include <stdbool.h>
#include <stdint.h>

typedef void (*Logger)(void *, Status, const char *, const char *);
