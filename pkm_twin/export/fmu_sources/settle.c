/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* What sticks and what slides. */
/* Forces within bounds that resist the motions of rows z: w = motion - a force is zero where the
   force is between its bounds, else of its sign. Block pivoting (Judice and Pires 1994). */
static int resist(
    double (*a)[DRY], const double *motion, const int *z, int count, double *force, int *state)
{
    double matrix[DRY * DRY], rest[DRY], size = 0.0, most = 0.0;
    int held[DRY], sweep, i, j;
    for (i = 0; i < count; i++) {
        size = fmax(size, fabs(motion[i]) + (a[i][i] * FRICTION[z[i]]));
        most = fmax(most, a[i][i]);
        state[i] = 0;
    }
    for (sweep = 0; sweep < 1000; sweep++) {
        int n = 0, changes = 0;
        for (i = 0; i < count; i++) {
            force[i] = (double)state[i] * FRICTION[z[i]];
            if (state[i] == 0) {
                held[n++] = i;
            }
        }
        for (i = 0; i < n; i++) {
            rest[i] = motion[held[i]];
            for (j = 0; j < count; j++) {
                rest[i] -= a[held[i]][j] * force[j];
            }
            for (j = 0; j < n; j++) {
                matrix[(i * n) + j] = a[held[i]][held[j]] + ((i == j) ? (REGULAR * most) : 0.0);
            }
        }
        if (cholesky(matrix, n, 0.0) == 0) {
            return 1;
        }
        solve(matrix, n, rest);
        for (i = 0; i < n; i++) {
            force[held[i]] = rest[i];
        }
        for (i = 0; i < count; i++) {
            const double wrong = TOLERANCE * size / fmax(a[i][i], 1e-300);
            double left = motion[i];
            int turned = state[i];
            for (j = 0; j < count; j++) {
                left -= a[i][j] * force[j];
            }
            if (state[i] == 0) {
                turned = (force[i] > (FRICTION[z[i]] + wrong)) ? 1 : 0;
                turned = (force[i] < -(FRICTION[z[i]] + wrong)) ? -1 : turned;
            } else if (((double)state[i] * left) < (-TOLERANCE * size)) {
                turned = 0;
            }
            /* Of many sweeps each changes one row, which ends. */
            if ((turned != state[i]) && ((sweep < 10) || (changes == 0))) {
                state[i] = turned;
                changes++;
            }
        }
        if (changes == 0) {
            return 0;
        }
    }
    return 1;
}

/* Which rows stick and which slide, from here on; a row that came to rest has no rate any more. */
static int event(Model *m, int *changed)
{
    double t[TERMS], l[N * N], rest[N], row[DRY][N], across[DRY][N], a[DRY][DRY];
    double motion[DRY], force[DRY], factor[DRY * DRY], before[N];
    double *x = m->v + Q;
    int z[DRY], state[DRY], own[DRY], i, j, k, count = 0, independent = 0;
    int status = prepare(m);
    *changed = 0;
    if (status == 0) {
        status = terms(m, x, t, l);
    }
    if (status != 0) {
        return status;
    }
    forces(m, x, t, rest);
    for (i = 0; i < DRY; i++) {
        double rate, largest = 0.0;
        row_of(t, i, row[i]);
        rate = dot(row[i], x + N);
        for (k = 0; k < N; k++) {
            largest = fmax(largest, fabs(row[i][k] * x[N + k]));
        }
        if ((m->mode[i] == SLIDES) && (m->sign[i] == 0) && (fabs(rate) > (STILL * largest))) {
            m->sign[i] = (rate > 0.0) ? 1 : -1;
        }
        if ((m->mode[i] == SLIDES) && (((double)m->sign[i] * rate) > 0.0)) {
            m->pull[i] = FRICTION[i] * (double)m->sign[i];
            for (k = 0; k < N; k++) {
                rest[k] -= row[i][k] * m->pull[i];
            }
        } else {
            z[count++] = i;
        }
    }
    solve(l, N, rest);
    for (i = 0; i < count; i++) {
        memcpy(across[i], row[z[i]], sizeof across[i]);
        solve(l, N, across[i]);
        motion[i] = dot(row[z[i]], rest) + drift_of(t, z[i]);
        for (j = 0; j < count; j++) {
            a[j][i] = dot(row[z[j]], across[i]);
        }
    }
    if (resist(a, motion, z, count, force, state) != 0) {
        return 1;
    }
    /* First what is held, then what moves: a row that depends on those that hold is still. */
    for (k = 0; k < 2; k++) {
        for (i = 0; i < count; i++) {
            double left = a[i][i];
            int depends;
            if ((state[i] == 0) != (k == 0)) {
                continue;
            }
            for (j = 0; j < independent; j++) {
                double sum = a[i][own[j]];
                int n;
                for (n = 0; n < j; n++) {
                    sum -= factor[(independent * DRY) + n] * factor[(j * DRY) + n];
                }
                factor[(independent * DRY) + j] = sum / factor[(j * DRY) + j];
                left -= factor[(independent * DRY) + j] * factor[(independent * DRY) + j];
            }
            depends = (left > (DEPENDENT * a[i][i])) ? 0 : 1;
            m->sign[z[i]] = state[i];
            m->pull[z[i]] = force[i];
            m->mode[z[i]] = (depends != 0) ? RESTS : ((k == 0) ? HOLDS : SLIDES);
            m->slack[z[i]] = 0.0;
            for (j = 0; j < count; j++) {
                const double size = fabs(motion[j]) + (a[j][j] * FRICTION[z[j]]);
                m->slack[z[i]] = fmax(m->slack[z[i]], 2.0 * TOLERANCE * size / a[i][i]);
            }
            if (m->mode[z[i]] == HOLDS) {
                factor[(independent * DRY) + independent] = sqrt(left);
                own[independent++] = i;
            }
        }
    }
    memcpy(before, x + N, sizeof before);
    status = hold(m, t, l, 0, x + N, force);
    *changed = (memcmp(before, x + N, sizeof before) != 0) ? 1 : 0;
    touch(m);
    return status;
}
