/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* An FMU of inverse dynamics: it has no states. */
static int results(Model *m)
{
    int status = 0;
    if (m->results == 0) {
        const double *q = m->v + Q;
        status = prepare(m);
        if (status == 0) {
            status = @_torques_and_singularity_with(
                m->parameters, q, m->v + QD, m->v + QDD, m->v + WRENCH, m->v + TAU,
                m->v + SINGULARITY);
        }
        if (status == 0) {
            status = @_forward_with(m->parameters, q, m->v + POSE);
        }
        m->v[STATUS] = (double)status;
        m->results = (status == 0) ? 1 : 0;
    }
    return status;
}

static int rates(Model *m)
{
    (void)m;
    return 0;
}

static int event(Model *m, int *changed)
{
    (void)m;
    *changed = 0;
    return 0;
}

static int advance(Model *m, double span)
{
    (void)span;
    touch(m);
    return results(m);
}
