/* The bootloader on a computer, with the hardware functions of flasher_dut.h. */
#include "boot.h"
#include "config.h"
#include "flasher_dut.h"

static const flasher_dut_facts facts = {
    .abi = FLASHER_DUT_ABI,
    .flash_bytes = APPLICATION_BYTES + SECTOR_BYTES,
    .sector_bytes = SECTOR_BYTES,
    .write_bytes = WRITE_BYTES,
    .application_offset = 0,
    .application_bytes = APPLICATION_BYTES,
    .erase_us = 22000, /* typical for a microcontroller of this size */
    .write_us = 85,
    .receive_frames = 32,
    .name = "example bootloader in C",
};

static const flasher_host *host;
static uint64_t started_us;

/* The counter overflows shortly after each start, to expose comparisons that ignore it. */
#define MS_AT_START (UINT32_MAX - 120)

uint32_t hal_ms(void)
{
    return MS_AT_START + (uint32_t)((host->now_us() - started_us) / 1000);
}

bool hal_sent_all(void)
{
    return host->transmit_pending() == 0;
}

void hal_flash_read(uint32_t offset, uint8_t *data, uint32_t size)
{
    host->flash_read(offset, data, size);
}

bool hal_flash_erase(uint32_t offset)
{
    return host->flash_erase(offset) == 0;
}

bool hal_flash_write(uint32_t offset, const uint8_t *data, uint32_t size)
{
    return host->flash_write(offset, data, size) == 0;
}

_Noreturn void hal_start_application(void)
{
    host->start_application();
    for (;;) {
    }
}

_Noreturn void hal_reset(void)
{
    host->reset();
    for (;;) {
    }
}

const flasher_dut_facts *flasher_dut_about(void)
{
    return &facts;
}

void flasher_dut_start(const flasher_host *given, uint32_t cause)
{
    (void)cause; /* all starts are equal */
    host = given;
    started_us = host->now_us();
    boot_start();
}

void flasher_dut_receive(const flasher_frame *frame)
{
    can_frame received = {
        .id = frame->id,
        .length = frame->length,
        .extended = frame->extended,
        .remote = frame->remote,
    };
    for (unsigned i = 0; i < sizeof received.data; ++i)
        received.data[i] = frame->data[i];
    boot_receive(&received);
}

uint64_t flasher_dut_tick(uint64_t now_us)
{
    const uint64_t ms = (now_us - started_us) / 1000;
    return started_us + (ms + boot_poll()) * 1000;
}

int flasher_dut_next_frame(flasher_frame *frame)
{
    can_frame sent;
    if (!boot_next_frame(&sent))
        return 0;
    *frame = (flasher_frame){.id = sent.id, .length = sent.length};
    for (unsigned i = 0; i < sent.length; ++i)
        frame->data[i] = sent.data[i];
    return 1;
}
