#include "crc.h"

/* The first 16 entries of the document's table are enough to process half a byte at a time. */
static const uint32_t table[16] = {
    0x00000000u, 0x04C11DB7u, 0x09823B6Eu, 0x0D4326D9u, 0x130476DCu, 0x17C56B6Bu,
    0x1A864DB2u, 0x1E475005u, 0x2608EDB8u, 0x22C9F00Fu, 0x2F8AD6D6u, 0x2B4BCB61u,
    0x350C9B64u, 0x31CD86D3u, 0x3C8EA00Au, 0x384FBDBDu,
};

uint32_t crc_add(uint32_t crc, const uint8_t *data, uint32_t size)
{
    for (uint32_t i = 0; i < size; ++i) {
        crc ^= data[i]; /* into the low byte: the document treats each byte as a word */
        for (unsigned step = 0; step < 8; ++step)
            crc = (crc << 4) ^ table[crc >> 28];
    }
    return crc;
}
