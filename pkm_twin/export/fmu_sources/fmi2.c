/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Functions of FMI 2.0 that take no instance. */
EXPORT const char *FMI(GetTypesPlatform)(void)
{
    return "default";
}

EXPORT const char *FMI(GetVersion)(void)
{
    return "2.0";
}

EXPORT void *FMI(Instantiate)(
    const char *name, int kind, const char *token, const char *resources,
    const Callbacks *callbacks, int visible, int logging)
{
    (void)kind;
    (void)resources;
    (void)visible;
    (void)logging;
    return instantiate(name, token, (callbacks != NULL) ? callbacks->logger : NULL,
        (callbacks != NULL) ? callbacks->environment : NULL);
}

EXPORT void FMI(FreeInstance)(void *instance)
{
    free(instance);
}
