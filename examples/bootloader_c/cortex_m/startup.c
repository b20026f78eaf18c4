/* Vector table and start-up code of bootloader and application. */
#include "board.h"

#include <stddef.h>

extern uint32_t data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_top[];
int main(void);
void systick_handler(void);
void uart_handler(void);
void *memcpy(void *restrict to, const void *restrict from, size_t size);
void *memset(void *at, int byte, size_t size);

_Noreturn static void reset_handler(void)
{
    uint32_t *to = data_start;
    for (const uint32_t *from = data_load; to < data_end; ++from)
        *to++ = *from;
    for (to = bss_start; to < bss_end;)
        *to++ = 0;
    (void)main();
    board_reset();
}

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) const struct {
    uint32_t *stack;
    handler handlers[16];
} vectors = {
    stack_top,
    {
        reset_handler,
        board_reset, /* NMI */
        board_reset, /* hard fault */
        board_reset, board_reset, board_reset, 0, 0, 0, 0, board_reset, board_reset, 0, board_reset,
        systick_handler,
        uart_handler, /* interrupt 0 */
    },
};

/* The compiler generates calls of these even without a library. */
void *memcpy(void *restrict to, const void *restrict from, size_t size)
{
    uint8_t *target = to;
    const uint8_t *source = from;
    while (size-- > 0)
        *target++ = *source++;
    return to;
}

void *memset(void *at, int byte, size_t size)
{
    uint8_t *target = at;
    while (size-- > 0)
        *target++ = (uint8_t)byte;
    return at;
}
