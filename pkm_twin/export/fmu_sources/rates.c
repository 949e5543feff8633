/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Accelerations. */
/* Accelerations a, and event indicators z, which fall through zero where a mode ends. */
static int accelerate(const Model *m, const double *x, double *a, double *z)
{
    double t[TERMS], l[N * N];
    int status = terms(m, x, t, l);
    if (status != 0) {
        return status;
    }
    forces(m, x, t, a);
#if DRY > 0
    {
        double row[N], force[DRY];
        int i, k;
        memset(force, 0, sizeof force);
        for (i = 0; i < DRY; i++) {
            if (m->mode[i] != HOLDS) {
                row_of(t, i, row);
                for (k = 0; k < N; k++) {
                    a[k] -= row[k] * m->pull[i];
                }
            }
        }
        solve(l, N, a);
        status = hold(m, t, l, 1, a, force);
        for (i = 0; i < DRY; i++) {
            row_of(t, i, row);
            z[i] = 1.0;
            if (m->mode[i] == SLIDES) {
                z[i] = ((double)m->sign[i] * dot(row, x + N)) + CREEP;
            }
            if (m->mode[i] == HOLDS) {
                z[i] = (FRICTION[i] - fabs(force[i])) + m->slack[i];
            }
        }
    }
#else
    (void)z;
    solve(l, N, a);
#endif
    return status;
}
