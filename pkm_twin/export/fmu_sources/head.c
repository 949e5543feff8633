/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "@.h"

#define ANY(count) (((count) > 0) ? (count) : 1)
