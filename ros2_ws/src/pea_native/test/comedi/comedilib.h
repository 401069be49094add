/* As much of comedi's interface as comedi.c uses, where libcomedi-dev is not installed. */
#ifndef COMEDILIB_H
#define COMEDILIB_H

typedef struct comedi_card comedi_t;
typedef unsigned int lsampl_t;

typedef struct {
    double min, max;
    unsigned int unit;
} comedi_range;

enum { COMEDI_SUBD_AI = 1, COMEDI_SUBD_AO = 2 };
enum { AREF_GROUND = 0 };
enum comedi_oor_behavior { COMEDI_OOR_NUMBER = 0, COMEDI_OOR_NAN };

comedi_t *comedi_open(const char *path);
int comedi_close(comedi_t *card);
int comedi_errno(void);
const char *comedi_strerror(int number);
const char *comedi_get_board_name(comedi_t *card);
const char *comedi_get_driver_name(comedi_t *card);
int comedi_find_subdevice_by_type(comedi_t *card, int type, unsigned int from);
comedi_range *comedi_get_range(comedi_t *card, unsigned int subdevice, unsigned int channel,
                               unsigned int range);
lsampl_t comedi_get_maxdata(comedi_t *card, unsigned int subdevice, unsigned int channel);
int comedi_data_read(comedi_t *card, unsigned int subdevice, unsigned int channel,
                     unsigned int range, unsigned int reference, lsampl_t *data);
int comedi_data_write(comedi_t *card, unsigned int subdevice, unsigned int channel,
                      unsigned int range, unsigned int reference, lsampl_t data);
enum comedi_oor_behavior comedi_set_global_oor_behavior(enum comedi_oor_behavior behavior);
double comedi_to_phys(lsampl_t data, comedi_range *range, lsampl_t highest);
lsampl_t comedi_from_phys(double volts, comedi_range *range, lsampl_t highest);

#endif
