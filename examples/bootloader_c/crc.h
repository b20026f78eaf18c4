#ifndef CRC_H
#define CRC_H

#include <stdint.h>

#define CRC_START 0xFFFFFFFFu

/* CRC of appendix 1. Start with CRC_START; continue with the result of the previous call. */
uint32_t crc_add(uint32_t crc, const uint8_t *data, uint32_t size);

#endif
