/* The application in flash, and the image on its way there. */
#ifndef STORE_H
#define STORE_H

#include "flasher_dut.h"

void store_start(const flasher_host *host);

/* Finishes a copy or exchange of banks that is ordered. */
void store_install(void);
int store_is_runnable(void);

/* Prepares for an image; not 0 when the flash reports an error. */
int store_begin(uint32_t size);
/* Erases sector number `step`; 0 when there is none, or the flash reports an error. */
int store_erase(uint32_t step);
void store_append(const uint8_t *data, uint32_t used, int is_last);
int store_failed(void);
/* Writes the rest, compares, and records the image; not 0 when the flash holds it. */
int store_finish(void);

/* Work that waits until the answers have left. */
int store_has_work(void);
void store_work(void);

#endif
