/* Hardware of the bootloader; the board's memory simulates flash memory. */
#include "board.h"
#include "boot.h"
#include "config.h"

uint32_t hal_ms(void)
{
    return board_ms();
}

bool hal_sent_all(void)
{
    return board_sent_all();
}

static uint8_t *memory(uint32_t offset)
{
    return (uint8_t *)(APPLICATION_AT + offset);
}

void hal_flash_read(uint32_t offset, uint8_t *data, uint32_t size)
{
    for (uint32_t i = 0; i < size; ++i)
        data[i] = memory(offset)[i];
}

/* Blocks the processor like the erase of a real chip, which takes longer. */
enum { ERASE_MS = 5 };

bool hal_flash_erase(uint32_t offset)
{
    const uint32_t began_ms = board_ms();
    while (board_ms() - began_ms <= ERASE_MS) {
    }
    for (uint32_t i = 0; i < SECTOR_BYTES; ++i)
        memory(offset)[i] = 0xFF;
    return true;
}

bool hal_flash_write(uint32_t offset, const uint8_t *data, uint32_t size)
{
    for (uint32_t i = 0; i < size; ++i) {
        if (memory(offset)[i] != 0xFF)
            return false; /* written before */
        memory(offset)[i] = data[i];
    }
    return true;
}

_Noreturn void hal_start_application(void)
{
    board_enter(APPLICATION_AT);
}

_Noreturn void hal_reset(void)
{
    board_reset();
}

int main(void)
{
    can_frame frame;
    board_start();
    boot_start();
    for (;;) {
        const bool received = board_receive(&frame);
        if (received)
            boot_receive(&frame);
        const uint32_t due_in_ms = boot_poll();
        while (boot_next_frame(&frame))
            board_send(&frame);
        if (!received && due_in_ms > 0)
            board_sleep();
    }
}
