/* The driver of a board over UDP, which goes wrong at SIGUSR1 as PEA_SPOIL says. */
#include <math.h>
#include <signal.h>
#include <stdlib.h>

#define pea_driver_exchange right_exchange
#include "udp.c"
#undef pea_driver_exchange

static volatile sig_atomic_t wrong;
static int *volatile nowhere;

static void go_wrong(int number)
{
    (void)number;
    wrong = 1;
}

__attribute__((constructor)) static void begin(void) { signal(SIGUSR1, go_wrong); }

int pea_driver_exchange(pea_device *d, double u, uint32_t flags, pea_sample *sample)
{
    const char *how = wrong ? getenv("PEA_SPOIL") : NULL;
    int code = right_exchange(d, u, flags, sample);
    if (!how)
        return code;
    if (!strcmp(how, "crash"))
        *nowhere = 1;
    if (!strcmp(how, "abort"))
        abort();
    if (!strcmp(how, "exit"))
        exit(0);
    if (!strcmp(how, "hang"))
        for (;;)
            sleep_until(now() + 1000000000);
    if (!strcmp(how, "spin"))
        for (;;)
            now();
    if (!strcmp(how, "pause")) {
        sleep_until(now() + 1000000000);
        wrong = 0;
    }
    if (!strcmp(how, "lie"))
        sample->u_applied = NAN;
    return strcmp(how, "refuse") ? code : PEA_REFUSED;
}
