/* The device's side of the upgrade protocol (Welling V1.0.0, chapter 5). */
#ifndef BOOT_H
#define BOOT_H

#include "hal.h"

/* To be called once after each reset, before the other functions. */
void boot_start(void);

/* Processes a received frame of any kind. Call boot_poll next. */
void boot_receive(const can_frame *frame);

/* One pass of the main loop; returns the longest time until the next one, in milliseconds. */
uint32_t boot_poll(void);

/* The next frame to send, if there is one. */
bool boot_next_frame(can_frame *frame);

#endif
