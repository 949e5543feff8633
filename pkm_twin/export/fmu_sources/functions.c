/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
EXPORT Status FMI(EnterEventMode)(void *instance)
{
    (void)instance;
    return STATUS_OK;
}

EXPORT Status FMI(EnterContinuousTimeMode)(void *instance)
{
    (void)instance;
    return STATUS_OK;
}

EXPORT Status FMI(Terminate)(void *instance)
{
    return enter((Instance *)instance, RUNNING, ENDED);
}

EXPORT Status FMI(Reset)(void *instance)
{
    Instance *c = (Instance *)instance;
    begin(&c->model);
    return STATUS_OK;
}

EXPORT Status FMI(ExitInitializationMode)(void *instance)
{
    Instance *c = (Instance *)instance;
    int changed;
    if (enter(c, INITIALISING, RUNNING) != STATUS_OK) {
        return STATUS_ERROR;
    }
    return update(c, &changed);
}

EXPORT Status FMI(SetTime)(void *instance, double time)
{
    Instance *c = (Instance *)instance;
    c->model.v[0] = time;
    return STATUS_OK;
}

EXPORT Status FMI(GetNominalsOfContinuousStates)(void *instance, double *values, size_t count)
{
    (void)instance;
    return nominals(values, count);
}

EXPORT Status FMI(SetContinuousStates)(void *instance, const double *x, size_t count)
{
    Instance *c = (Instance *)instance;
    return set_states(c, x, count);
}

EXPORT Status FMI(GetContinuousStates)(void *instance, double *x, size_t count)
{
    Instance *c = (Instance *)instance;
    return get_states(c, x, count);
}

EXPORT Status FMI(GetEventIndicators)(void *instance, double *values, size_t count)
{
    Instance *c = (Instance *)instance;
    return get_indicators(c, values, count);
}

EXPORT Status FMI(GetFMUSTATE)(void *instance, void **state)
{
    Instance *c = (Instance *)instance;
    return copy_state(c, state);
}

EXPORT Status FMI(SetFMUSTATE)(void *instance, void *state)
{
    Instance *c = (Instance *)instance;
    return restore(c, state, sizeof c->model);
}

EXPORT Status FMI(FreeFMUSTATE)(void *instance, void **state)
{
    (void)instance;
    return forget(state);
}

EXPORT Status FMI(SerializedFMUSTATESize)(void *instance, void *state, size_t *size)
{
    (void)instance;
    (void)state;
    *size = SAVED;
    return STATUS_OK;
}

EXPORT Status FMI(SerializeFMUSTATE)(void *instance, void *state, unsigned char *bytes, size_t size)
{
    Instance *c = (Instance *)instance;
    return save(c, state, bytes, size);
}

EXPORT Status FMI(DESERIALIZE)(void *instance, const unsigned char *bytes, size_t size, void **state)
{
    Instance *c = (Instance *)instance;
    return load(c, bytes, size, state);
}

EXPORT Status FMI(GetDERIVATIVES)(void *instance, double *values, size_t count)
{
    Instance *c = (Instance *)instance;
    return get_rates(c, values, count);
}
