/* Driver of a data acquisition card through comedi: one analogue output, one analogue input.
 *
 * Address: /dev/comedi0, then options behind a question mark, joined by &:
 *   out=0 in=0             channels
 *   amplifier=0:15         V at the actuator = first + second * V at the output
 *   sensor=0:1             um = first + second * V at the input
 * for example /dev/comedi0?amplifier=0:15&sensor=10:2. The clock is the loop's: an exchange writes
 * the output and converts the input once. Needs libcomedi (Debian: libcomedi-dev), link -lcomedi.
 */
#include <comedilib.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "pea_driver.h"

struct pea_device {
    comedi_t *card;
    int out, in; /* subdevices */
    unsigned out_channel, in_channel;
    comedi_range *out_range, *in_range;
    lsampl_t out_max, in_max;
    double amplifier[2], sensor[2], held;
    uint64_t counter;
    char identity[128];
};

static pea_device *refuse(pea_device *d, char *error, size_t size, const char *what)
{
    snprintf(error, size, "%s", what);
    if (d && d->card)
        comedi_close(d->card);
    free(d);
    return NULL;
}

uint32_t pea_driver_version(void) { return PEA_DRIVER_VERSION; }

static int write_volts(pea_device *d, double u)
{
    double v = (u - d->amplifier[0]) / d->amplifier[1];
    lsampl_t raw = comedi_from_phys(v, d->out_range, d->out_max);
    int done = comedi_data_write(d->card, (unsigned)d->out, d->out_channel, 0, AREF_GROUND, raw);
    if (done < 1)
        return PEA_LOST;
    d->held = d->amplifier[0] + d->amplifier[1] * comedi_to_phys(raw, d->out_range, d->out_max);
    return PEA_OK;
}

pea_device *pea_driver_open(const pea_options *options, char *error, size_t size)
{
    char path[256];
    pea_device *d = calloc(1, sizeof *d);
    if (!d)
        return refuse(d, error, size, "no memory");
    d->amplifier[1] = d->sensor[1] = 1.0;
    snprintf(path, sizeof path, "%s", options->address);
    char *rest = strchr(path, '?');
    if (rest)
        *rest++ = 0;
    for (char *word = rest ? strtok(rest, "&") : NULL; word; word = strtok(NULL, "&")) {
        int read = sscanf(word, "out=%u", &d->out_channel) + sscanf(word, "in=%u", &d->in_channel);
        read += sscanf(word, "amplifier=%lf:%lf", &d->amplifier[0], &d->amplifier[1]);
        read += sscanf(word, "sensor=%lf:%lf", &d->sensor[0], &d->sensor[1]);
        if (read < 1)
            return refuse(d, error, size, "options are out=N, in=N, amplifier=A:B, sensor=A:B");
    }
    if (options->pace != PEA_CLOCK)
        return refuse(d, error, size, "a comedi card is read at the loop's clock: pace: clock");
    if (d->amplifier[1] == 0.0 || d->sensor[1] == 0.0)
        return refuse(d, error, size, "a slope of 0 has no inverse");
    comedi_set_global_oor_behavior(COMEDI_OOR_NUMBER); /* an output may stand at its end */
    d->card = comedi_open(path);
    if (!d->card)
        return refuse(d, error, size, comedi_strerror(comedi_errno()));
    d->out = comedi_find_subdevice_by_type(d->card, COMEDI_SUBD_AO, 0);
    d->in = comedi_find_subdevice_by_type(d->card, COMEDI_SUBD_AI, 0);
    if (d->out < 0 || d->in < 0)
        return refuse(d, error, size, "the card needs an analogue output and an analogue input");
    d->out_range = comedi_get_range(d->card, (unsigned)d->out, d->out_channel, 0);
    d->in_range = comedi_get_range(d->card, (unsigned)d->in, d->in_channel, 0);
    d->out_max = comedi_get_maxdata(d->card, (unsigned)d->out, d->out_channel);
    d->in_max = comedi_get_maxdata(d->card, (unsigned)d->in, d->in_channel);
    if (!d->out_range || !d->in_range || !d->out_max || !d->in_max)
        return refuse(d, error, size, "the card has no such channel");
    lsampl_t raw;
    if (comedi_data_read(d->card, (unsigned)d->out, d->out_channel, 0, AREF_GROUND, &raw) < 1)
        return refuse(d, error, size, "the output cannot be read back: what it holds is unknown");
    d->held = d->amplifier[0] + d->amplifier[1] * comedi_to_phys(raw, d->out_range, d->out_max);
    snprintf(d->identity, sizeof d->identity, "%s (%s)", comedi_get_board_name(d->card),
             comedi_get_driver_name(d->card));
    return d;
}

int pea_driver_identify(pea_device *d, char *text, size_t size)
{
    snprintf(text, size, "%s", d->identity);
    return PEA_OK;
}

static void span(const double line[2], const comedi_range *range, double *low, double *high)
{
    double a = line[0] + line[1] * range->min, b = line[0] + line[1] * range->max;
    *low = a < b ? a : b;
    *high = a < b ? b : a;
}

int pea_driver_limits(pea_device *d, pea_limits *limits)
{
    span(d->amplifier, d->out_range, &limits->voltage_min, &limits->voltage_max);
    span(d->sensor, d->in_range, &limits->y_min, &limits->y_max);
    limits->y_min *= 1e-6;
    limits->y_max *= 1e-6;
    return PEA_OK;
}

int pea_driver_exchange(pea_device *d, double u, uint32_t flags, pea_sample *sample)
{
    lsampl_t raw;
    sample->u_applied = d->held;
    if (comedi_data_read(d->card, (unsigned)d->in, d->in_channel, 0, AREF_GROUND, &raw) < 1)
        return PEA_LOST;
    double volts = comedi_to_phys(raw, d->in_range, d->in_max);
    sample->y = (d->sensor[0] + d->sensor[1] * volts) * 1e-6;
    if (raw == 0 || raw == d->in_max)
        sample->y = NAN; /* beyond the input's range: unknown */
    sample->counter = ++d->counter;
    return flags & PEA_HOLD ? PEA_OK : write_volts(d, u);
}

int pea_driver_safe(pea_device *d, double u) { return write_volts(d, u); }

void pea_driver_close(pea_device *d)
{
    comedi_close(d->card);
    free(d);
}
