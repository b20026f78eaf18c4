#ifndef CRC_H
#define CRC_H

#include <stdint.h>

#define CRC_START 0xFFFFFFFFu

/* The CRC of appendix 1. Begins with CRC_START; goes on with what an earlier call returned. */
uint32_t crc_add(uint32_t crc, const uint8_t *data, uint32_t size);

#endif
