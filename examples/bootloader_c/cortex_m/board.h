/* Board functions of bootloader and application: QEMU's mps2-an385, a Cortex-M3 whose CAN
 * controller is a UART with the slcan protocol.
 */
#ifndef BOARD_H
#define BOARD_H

#include "hal.h"

/* The bootloader has the first 8 KiB of memory. */
#define APPLICATION_AT 0x2000u

void board_start(void);
uint32_t board_ms(void);

/* The next data or remote frame received, if there is one. */
bool board_receive(can_frame *frame);
void board_send(const can_frame *frame);
bool board_sent_all(void);

/* Sleeps until a character is received, for at most 1 ms. */
void board_sleep(void);

_Noreturn void board_reset(void);

/* Stops the clock and the UART, and starts the program with this vector table. */
_Noreturn void board_enter(uint32_t vectors);

#endif
