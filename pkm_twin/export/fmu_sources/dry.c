/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Rows with dry friction, and those that hold. */
/* Modes of a row with dry friction: it slides; it holds; or it is still as others hold it. */
enum { SLIDES, HOLDS, RESTS };

/* Rates of the row by joint rates: of an actuated joint, or of a passive one. */
static void row_of(const double *t, int i, double *row)
{
    int k;
    for (k = 0; k < N; k++) {
        row[k] = (ROW[i] < N) ? ((ROW[i] == k) ? 1.0 : 0.0) : t[ROWS + ((ROW[i] - N) * N) + k];
    }
}

static double drift_of(const double *t, int i)
{
    return (ROW[i] < N) ? 0.0 : t[DRIFT + (ROW[i] - N)];
}

static double dot(const double *a, const double *b)
{
    double sum = 0.0;
    int k;
    for (k = 0; k < N; k++) {
        sum += a[k] * b[k];
    }
    return sum;
}

/* Change a, joint rates or accelerations, so that the rows that hold have none; their forces. */
static int hold(
    const Model *m, const double *t, const double *l, int second, double *a, double *force)
{
    double row[N][N], across[N][N], s[N * N], f[N];
    int held[N] = {0};
    int i, j, k, count = 0;
    for (i = 0; (i < DRY) && (count < N); i++) {
        if (m->mode[i] == HOLDS) {
            held[count] = i;
            row_of(t, i, row[count]);
            memcpy(across[count], row[count], sizeof row[count]);
            solve(l, N, across[count]);
            f[count] = dot(row[count], a) + ((second != 0) ? drift_of(t, i) : 0.0);
            count++;
        }
    }
    for (i = 0; i < count; i++) {
        for (j = 0; j <= i; j++) {
            s[(i * count) + j] = dot(row[i], across[j]);
        }
    }
    if (cholesky(s, count, 0.0) == 0) {
        return 1;
    }
    solve(s, count, f);
    for (i = 0; i < count; i++) {
        for (k = 0; k < N; k++) {
            a[k] -= across[i][k] * f[i];
        }
        force[held[i]] = f[i];
    }
    for (i = 0; i < count; i++) {
        if (ROW[held[i]] < N) {
            a[ROW[held[i]]] = 0.0;
        }
    }
    return 0;
}
