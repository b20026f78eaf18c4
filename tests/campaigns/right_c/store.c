/* A record after the application (size and CRC) makes it valid. With a second bank, the record after
 * that one orders the installation, which any start finishes.
 */
#include "store.h"

#include <string.h>

#include "choices.h"

enum { TRIES = 3, VALID = 0x51A9E0C3, TARGET_AT = BANKS == 1 ? APPLICATION_AT : SECOND_AT };

typedef struct {
    uint32_t magic, size, crc, check;
} record_t;

static const flasher_host *hw;
static uint32_t table[256];
static uint8_t page[PAGE_BYTES], sector[SECTOR_BYTES], other[SECTOR_BYTES];
static uint32_t filled, written, erased, size, crc, has_failed, has_work, dropped;

static uint32_t crc_add(uint32_t reg, const uint8_t *data, uint32_t count)
{
    while (count--)
        reg = reg >> 8 ^ table[(reg ^ *data++) & 0xFF];
    return reg;
}

static uint32_t crc_of_flash(uint32_t at, uint32_t count)
{
    uint32_t reg = 0xFFFFFFFFu;
    for (uint32_t part; count; at += part, count -= part) {
        part = count < SECTOR_BYTES ? count : SECTOR_BYTES;
        hw->flash_read(at, sector, part);
        reg = crc_add(reg, sector, part);
    }
    return ~reg;
}

void store_start(const flasher_host *host)
{
    hw = host;
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t value = i;
        for (int bit = 0; bit < 8; bit++)
            value = value & 1 ? value >> 1 ^ 0xEDB88320u : value >> 1;
        table[i] = value;
    }
}

/* -- operations that may fail ------------------------------------------------------------------- */

static int erase(uint32_t at)
{
    for (int i = 0; i <= RETRIES; i++)
        if (!hw->flash_erase(at))
            return 1;
    return 0;
}

static int is_blank(const uint8_t *data, uint32_t count)
{
    while (count--)
        if (*data++ != 0xFF)
            return 0;
    return 1;
}

static int write(uint32_t at, const uint8_t *data, uint32_t count)
{
    uint32_t part = UNIT_BY_UNIT || SKIPS_BLANK ? WRITE_BYTES : count;
    for (uint32_t done = 0; done < count; done += part) {
        int is_written = SKIPS_BLANK && is_blank(data + done, part);
        for (int i = 0; i <= RETRIES && !is_written; i++)
            is_written = !hw->flash_write(at + done, data + done, part);
        if (!is_written)
            return 0;
    }
    return 1;
}

static int holds(uint32_t at, const uint8_t *data, uint32_t count)
{
    for (uint32_t done = 0, part; done < count; done += part) {
        part = count - done < SECTOR_BYTES ? count - done : SECTOR_BYTES;
        hw->flash_read(at + done, other, part);
        if (memcmp(other, data + done, part))
            return 0;
    }
    return 1;
}

static int copy_sector(uint32_t to, uint32_t from)
{
    for (int i = 0; i < TRIES; i++) {
        hw->flash_read(from, sector, SECTOR_BYTES);
        if (erase(to) && write(to, sector, SECTOR_BYTES) && holds(to, sector, SECTOR_BYTES) &&
            holds(from, sector, SECTOR_BYTES))
            return 1;
    }
    return 0;
}

/* -- records ------------------------------------------------------------------------------------ */

static uint32_t check_of(const record_t *record)
{
    return ~crc_add(0xFFFFFFFFu, (const uint8_t *)record, 12);
}

static int read_record(uint32_t at, record_t *record)
{
    hw->flash_read(at, record, sizeof *record);
    return record->magic == VALID && record->check == check_of(record);
}

static int write_record(uint32_t at, const record_t *record)
{
    uint8_t unit[UNIT_BYTES];
    memset(unit, 0xFF, sizeof unit);
    memcpy(unit, record, sizeof *record);
    return write(at, unit, sizeof unit) && holds(at, unit, sizeof unit);
}

static int is_whole(uint32_t record_at, uint32_t bank_at, record_t *record)
{
    return read_record(record_at, record) && record->size <= APPLICATION_BYTES &&
           crc_of_flash(bank_at, record->size) == record->crc;
}

int store_is_runnable(void)
{
    record_t record;
    for (int i = 0; i < TRIES; i++)
        if (is_whole(RECORD_AT, APPLICATION_AT, &record))
            return 1;
    return 0;
}

/* -- two banks ---------------------------------------------------------------------------------- */

static int copy_bank(const record_t *order)
{
    if (!erase(RECORD_AT))
        return 0;
    for (uint32_t at = 0; at < order->size; at += SECTOR_BYTES)
        if (!copy_sector(APPLICATION_AT + at, SECOND_AT + at))
            return 0;
    return 1;
}

/* Step 3n saves sector n of the application, 3n + 1 installs the new one, 3n + 2 keeps the old one. */
static int exchange_banks(const record_t *order)
{
    uint32_t done = 0, unit = 0, entry[4];
    for (uint32_t at = 0; at < JOURNAL_BYTES; at += UNIT_BYTES) {
        hw->flash_read(JOURNAL_AT + at, entry, sizeof entry);
        if (entry[0] == ~entry[1] && entry[2] == VALID && entry[0] > done)
            done = entry[0];
        if (!is_blank((const uint8_t *)entry, sizeof entry))
            unit = at / UNIT_BYTES + 1;
    }
    for (uint32_t at = 0; !unit && at < JOURNAL_BYTES; at += SECTOR_BYTES)
        if (!erase(JOURNAL_AT + at)) /* its first write may have been cut, and look blank */
            return 0;
    unit += unit > 0; /* as the last one may */
    for (; done < 3 * SECTORS(order->size); done++) {
        uint32_t at = done / 3 * SECTOR_BYTES;
        uint32_t to[3] = {SCRATCH_AT, APPLICATION_AT + at, SECOND_AT + at};
        uint32_t from[3] = {APPLICATION_AT + at, SECOND_AT + at, SCRATCH_AT};
        uint8_t bytes[UNIT_BYTES];
        if (!copy_sector(to[done % 3], from[done % 3]))
            return 0;
        memset(bytes, 0xFF, sizeof bytes);
        memcpy(bytes, (uint32_t[]){done + 1, ~(done + 1), VALID}, 12);
        for (; (unit + 1) * UNIT_BYTES <= JOURNAL_BYTES; unit++)
            if (write(JOURNAL_AT + unit * UNIT_BYTES, bytes, sizeof bytes) &&
                holds(JOURNAL_AT + unit * UNIT_BYTES, bytes, sizeof bytes))
                break;
        if ((++unit) * UNIT_BYTES > JOURNAL_BYTES)
            return 0;
    }
    return 1;
}

void store_install(void)
{
    record_t order, record;
    if (BANKS == 1 || !read_record(ORDER_AT, &order))
        return;
    if (BANKS == 2) {
        if (!is_whole(ORDER_AT, SECOND_AT, &order))
            return;
        if (is_whole(RECORD_AT, APPLICATION_AT, &record) && !memcmp(&record, &order, sizeof order)) {
            if (!KEEPS_SECOND)
                erase(ORDER_AT);
            return;
        }
    }
    if (!(BANKS == 2 ? copy_bank(&order) : exchange_banks(&order)))
        return;
    if (crc_of_flash(APPLICATION_AT, order.size) != order.crc)
        return;
    if (erase(RECORD_AT) && write_record(RECORD_AT, &order) && !(BANKS == 2 && KEEPS_SECOND))
        erase(ORDER_AT);
}

/* -- an image on its way ------------------------------------------------------------------------ */

int store_begin(uint32_t wanted)
{
    size = wanted;
    crc = 0xFFFFFFFFu;
    filled = written = erased = has_failed = has_work = dropped = 0;
    if (BANKS > 1) {
        has_failed = !erase(ORDER_AT);
        for (uint32_t at = 0; BANKS == 3 && at < JOURNAL_BYTES; at += SECTOR_BYTES)
            has_failed |= !erase(JOURNAL_AT + at);
    } else if (!(ERASE == 2 && RECORD_DROPPED_LATE)) {
        has_failed = !erase(RECORD_AT);
    }
    return (int)has_failed;
}

int store_erase(uint32_t step)
{
    uint32_t sectors = ERASE == 0 ? SECTORS(APPLICATION_BYTES) : ERASE == 1 ? SECTORS(size) : 0;
    if (step >= sectors || has_failed)
        return 0;
    has_failed = !erase(TARGET_AT + step * SECTOR_BYTES);
    erased = (step + 1) * SECTOR_BYTES;
    return !has_failed;
}

static void flush(void)
{
    uint32_t count = (filled + WRITE_BYTES - 1) / WRITE_BYTES * WRITE_BYTES;
    memset(page + filled, 0xFF, count - filled);
    has_work = 0;
    if (BANKS == 1 && ERASE == 2 && RECORD_DROPPED_LATE && !dropped) {
        has_failed |= !erase(RECORD_AT);
        dropped = 1;
    }
    for (; erased < written + count && !has_failed; erased += SECTOR_BYTES)
        has_failed = !erase(TARGET_AT + erased);
    if (!has_failed)
        has_failed = !write(TARGET_AT + written, page, count);
    if (!has_failed && VERIFIES)
        has_failed = !holds(TARGET_AT + written, page, count);
    written += filled;
    filled = 0;
}

void store_append(const uint8_t *data, uint32_t used, int is_last)
{
    if (has_work)
        flush();
    memcpy(page + filled, data, used);
    filled += used;
    crc = crc_add(crc, data, used);
    if (filled == PAGE_BYTES || (is_last && !LAST_AT_END)) {
        if (ACKS_FIRST)
            has_work = 1;
        else
            flush();
    }
}

int store_failed(void)
{
    return (int)has_failed;
}

int store_has_work(void)
{
    return (int)has_work;
}

void store_work(void)
{
    flush();
}

int store_finish(void)
{
    record_t record = {VALID, size, ~crc, 0};
    if (filled)
        flush();
    if (has_failed || crc_of_flash(TARGET_AT, size) != record.crc)
        return 0;
    if (IMAGE_CHECKSUM) {
        uint8_t last[4];
        if (size < 4)
            return 0;
        hw->flash_read(TARGET_AT + size - 4, last, 4);
        uint32_t value = crc_of_flash(TARGET_AT, size - 4);
        for (int i = 0; i < 4; i++)
            if (last[i] != (uint8_t)(value >> 8 * i))
                return 0;
    }
    record.check = check_of(&record);
    if (!write_record(BANKS == 1 ? RECORD_AT : ORDER_AT, &record))
        return 0;
    if (BANKS > 1 && COPIES_BEFORE_COMPLETE) {
        store_install();
        return store_is_runnable();
    }
    return 1;
}
