/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Without dry friction there are no events. */
static int event(Model *m, int *changed)
{
    *changed = 0;
    return prepare(m);
}
