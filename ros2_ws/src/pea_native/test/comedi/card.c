/* A card without hardware behind that interface: 12 bits out, 0 to 10 V; 16 bits in, +-10 V, which
 * sees half of the output. As in comedi, a reading at either end of a range is NaN unless asked
 * otherwise. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "comedilib.h"

struct comedi_card {
    lsampl_t out;
};

static comedi_t card;
static comedi_range out_range = {0.0, 10.0, 0}, in_range = {-10.0, 10.0, 0};
unsigned int card_input; /* what the input reads, where it is not 0 */
static enum comedi_oor_behavior at_the_end = COMEDI_OOR_NAN;

comedi_t *comedi_open(const char *path) { return strcmp(path, "/dev/comedi0") ? NULL : &card; }
int comedi_close(comedi_t *c) { return c ? 0 : -1; }
int comedi_errno(void) { return 1; }
const char *comedi_strerror(int number) { return number ? "no such card" : "none"; }
const char *comedi_get_board_name(comedi_t *c) { return c ? "card" : ""; }
const char *comedi_get_driver_name(comedi_t *c) { return c ? "test" : ""; }

int comedi_find_subdevice_by_type(comedi_t *c, int type, unsigned int from)
{
    (void)from;
    return c && type == COMEDI_SUBD_AO;
}

comedi_range *comedi_get_range(comedi_t *c, unsigned int subdevice, unsigned int channel,
                               unsigned int range)
{
    return !c || range || channel > 1 ? NULL : subdevice ? &out_range : &in_range;
}

lsampl_t comedi_get_maxdata(comedi_t *c, unsigned int subdevice, unsigned int channel)
{
    return !c || channel > 1 ? 0 : subdevice ? 4095 : 65535;
}

int comedi_data_read(comedi_t *c, unsigned int subdevice, unsigned int channel, unsigned int range,
                     unsigned int reference, lsampl_t *data)
{
    *data = subdevice ? c->out : 32768 + c->out * 65535 / 4095 / 4;
    if (!subdevice && card_input)
        *data = card_input;
    return range || reference || channel > 1 ? -1 : 1;
}

int comedi_data_write(comedi_t *c, unsigned int subdevice, unsigned int channel,
                      unsigned int range, unsigned int reference, lsampl_t data)
{
    c->out = data;
    return !subdevice || range || reference || channel > 1 ? -1 : 1;
}

enum comedi_oor_behavior comedi_set_global_oor_behavior(enum comedi_oor_behavior behavior)
{
    enum comedi_oor_behavior before = at_the_end;
    at_the_end = behavior;
    return before;
}

double comedi_to_phys(lsampl_t data, comedi_range *range, lsampl_t highest)
{
    if (at_the_end == COMEDI_OOR_NAN && (data == 0 || data >= highest))
        return NAN;
    return range->min + (range->max - range->min) * data / highest;
}

lsampl_t comedi_from_phys(double volts, comedi_range *range, lsampl_t highest)
{
    double share = (volts - range->min) / (range->max - range->min);
    return (lsampl_t)(fmin(fmax(share, 0.0), 1.0) * highest + 0.5);
}
