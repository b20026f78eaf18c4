#include "store.h"

#include "crc.h"
#include "hal.h"
#include "message.h"

enum {
    RECORD_AT = APPLICATION_BYTES,
    RECORD_BYTES = WRITE_BYTES > 16 ? WRITE_BYTES : 16, /* magic, size, CRC; CRC of these three */
};

#define RECORD_MAGIC 0x4B4F5041u

_Static_assert(APPLICATION_BYTES % SECTOR_BYTES == 0, "the application ends with a sector");
_Static_assert(SECTOR_BYTES % WRITE_BYTES == 0 && SECTOR_BYTES >= RECORD_BYTES, "a sector is units");
_Static_assert(PACKET_BYTES % WRITE_BYTES == 0, "a packet begins a unit, else it needs a buffer");
_Static_assert(RECORD_BYTES % WRITE_BYTES == 0, "the record is whole units");
_Static_assert(APPLICATION_BYTES / PACKET_BYTES < 65535, "packets have 16-bit numbers");

static uint32_t stored_crc(uint32_t size)
{
    uint8_t part[PACKET_BYTES];
    uint32_t crc = CRC_START;
    for (uint32_t at = 0; at < size; at += sizeof part) {
        const uint32_t count = size - at < sizeof part ? size - at : sizeof part;
        hal_flash_read(at, part, count);
        crc = crc_add(crc, part, count);
    }
    return crc;
}

/* A checksum of the product's images; the protocol has none. */
static bool has_checksum(uint32_t size)
{
    uint8_t part[PACKET_BYTES];
    uint32_t crc = 0xFFFFFFFFu, count;
    if (size <= 4)
        return false;
    for (uint32_t at = 0; at < size - 4; at += count) {
        count = size - 4 - at < sizeof part ? size - 4 - at : sizeof part;
        hal_flash_read(at, part, count);
        for (uint32_t bit = 0; bit < 8 * count; ++bit) {
            crc ^= (uint32_t)part[bit / 8] >> bit % 8 & 1u;
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
        }
    }
    hal_flash_read(size - 4, part, 4);
    return get32(part) == ~crc;
}

bool store_has_application(void)
{
    uint8_t record[RECORD_BYTES];
    hal_flash_read(RECORD_AT, record, sizeof record);
    const uint32_t size = get32(record + 4);
    return get32(record) == RECORD_MAGIC && get32(record + 12) == crc_add(CRC_START, record, 12) &&
           size >= 1 && size <= APPLICATION_BYTES && get32(record + 8) == stored_crc(size);
}

/* Erases empty sectors too: after an interrupted erase, cells can read as erased without being able
 * to hold data. Erases the whole area, so that no bytes of a longer application remain after a
 * shorter one. */
bool store_erase(uint32_t step)
{
    return hal_flash_erase(step == 0 ? RECORD_AT : (step - 1) * SECTOR_BYTES);
}

bool store_write(uint32_t offset, const uint8_t *data, uint32_t size)
{
    uint8_t units[PACKET_BYTES];
    for (uint32_t i = 0; i < sizeof units; ++i)
        units[i] = i < size ? data[i] : 0xFF;
    return hal_flash_write(offset, units, (size + WRITE_BYTES - 1) / WRITE_BYTES * WRITE_BYTES);
}

bool store_finish(uint32_t size, uint32_t crc)
{
    uint8_t record[RECORD_BYTES];
    if (stored_crc(size) != crc || (IMAGE_CHECKSUM && !has_checksum(size)))
        return false;
    for (uint32_t i = 16; i < sizeof record; ++i)
        record[i] = 0xFF;
    put32(record, RECORD_MAGIC);
    put32(record + 4, size);
    put32(record + 8, crc);
    put32(record + 12, crc_add(CRC_START, record, 12));
    return hal_flash_write(RECORD_AT, record, sizeof record) && store_has_application();
}
