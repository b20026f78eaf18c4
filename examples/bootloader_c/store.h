/* The application in flash memory, and the record that marks it as complete.
 *
 * The record holds the size and the CRC of the application. It is erased before anything else is
 * touched and written when all else is right, so that a power cut at any moment leaves either a
 * whole application with its record, or no record. What the flash memory holds after a cut in the
 * middle of erasing or writing is not known: the record has a CRC of its own, and the application's
 * is calculated anew at each start.
 */
#ifndef STORE_H
#define STORE_H

#include "config.h"

#include <stdbool.h>
#include <stdint.h>

enum { PACKET_BYTES = 128 };

/* True when a complete application is stored. Reads all of it. */
bool store_has_application(void);

/* Erases in steps 0 to STORE_ERASE_STEPS - 1, to be called in this order. */
enum { STORE_ERASE_STEPS = 1 + APPLICATION_BYTES / SECTOR_BYTES };
bool store_erase(uint32_t step);

/* Writes `size` bytes, 1 to PACKET_BYTES; `data` has PACKET_BYTES. */
bool store_write(uint32_t offset, const uint8_t *data, uint32_t size);

/* Writes the record if the written bytes equal the received ones. */
bool store_finish(uint32_t size, uint32_t crc);

#endif
