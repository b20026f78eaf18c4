/* What a product decides. Each value can be given to the compiler (-DSECTOR_BYTES=1024) instead. */
#ifndef CONFIG_H
#define CONFIG_H

/* -- who it is -------------------------------------------------------------------------------- */

#define TARGET_WMC 1
#define TARGET_BMS 2
#define TARGET_OBC 3

#ifndef TARGET
#define TARGET TARGET_BMS
#endif

#ifndef BOOT_VERSION
#define BOOT_VERSION "V1.0.0" /* of the bootloader, exactly this form */
#endif

/* -- flash memory, in bytes ------------------------------------------------------------------- */

/* From the first byte of the application on. The record that says that an application is whole has
 * the sector behind the application to itself, and nothing else may write there. */
#ifndef APPLICATION_BYTES
#define APPLICATION_BYTES (118u * 1024u)
#endif
#ifndef SECTOR_BYTES
#define SECTOR_BYTES 2048u /* erased at once */
#endif
#ifndef WRITE_BYTES
#define WRITE_BYTES 8u /* written at once, and once only after an erase; divides 128 */
#endif

/* -- behaviour that the documents leave open, times in ms ------------------------------------- */

/* RESET is the application's command. 1: a RESET restarts the bootloader as well. 0: ignored. */
#ifndef RESET_RESTARTS
#define RESET_RESTARTS 0
#endif

/* The protocol sends no checksum of the whole image. 1: each image ends with one, the CRC-32 of all
 * before it (that of zip, low byte first), and an image whose checksum is wrong is refused. */
#ifndef IMAGE_CHECKSUM
#define IMAGE_CHECKSUM 0
#endif

/* How long an update command is waited for behind the last boot version of a burst. */
#ifndef WINDOW_MS
#define WINDOW_MS 200u
#endif

/* A transfer ends when nothing of it was heard for so long. The tool may repeat a packet five times
 * at intervals of 500 ms: shorter than that would end a transfer that can be saved. */
#ifndef PAUSE_MS
#define PAUSE_MS 4000u
#endif

/* Frames of one message follow each other within this time. */
#ifndef INTER_FRAME_MS
#define INTER_FRAME_MS 100u
#endif

/* How long the last frames may wait for the bus before the application starts without them: nobody
 * takes frames from a device that is alone on the bus, and it has to start all the same. */
#ifndef DRAIN_MS
#define DRAIN_MS 200u
#endif

#endif
