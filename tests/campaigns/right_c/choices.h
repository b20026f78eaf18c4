/* The choices of this bootloader, each with a default; see boot.c. Times in microseconds. */
#ifndef CHOICES_H
#define CHOICES_H

/* -- the product */
#ifndef NODE
#define NODE 2 /* 1 WMC, 2 BMS, 3 OBC */
#endif
#ifndef BOOT_VERSION
#define BOOT_VERSION "V1.2.3"
#endif
#ifndef SECTOR_BYTES
#define SECTOR_BYTES 1024
#endif
#ifndef WRITE_BYTES
#define WRITE_BYTES 8
#endif
#ifndef APPLICATION_BYTES
#define APPLICATION_BYTES 12288
#endif
#ifndef LARGEST_BYTES
#define LARGEST_BYTES APPLICATION_BYTES /* the largest image that it accepts */
#endif
#ifndef ERASE_US
#define ERASE_US 5000
#endif
#ifndef WRITE_US
#define WRITE_US 60
#endif
#ifndef RECEIVE_FRAMES
#define RECEIVE_FRAMES 64
#endif

/* -- announcements */
#ifndef FIRST_US
#define FIRST_US 20000 /* from the start to the first one */
#endif
#ifndef BURST
#define BURST 4
#endif
#ifndef SPACING_US
#define SPACING_US 50000
#endif
#ifndef GAP_US
#define GAP_US 0 /* without an application: more time between two bursts */
#endif
#ifndef LISTENS
#define LISTENS 0 /* without an application: silent after the burst */
#endif
#ifndef WINDOW_US
#define WINDOW_US 60000
#endif
#ifndef START_US
#define START_US 10000 /* from the window's end, or complete, to the application */
#endif
#ifndef HEARS_BEFORE
#define HEARS_BEFORE 1 /* an update command before the first announcement */
#endif
#ifndef BURST_HEARS
#define BURST_HEARS 1 /* an update command in the burst: 0 lost, 1 at once, 2 after the burst */
#endif
#ifndef DEAF_ANSWERS
#define DEAF_ANSWERS 0 /* what is lost is refused aloud, with UPDATE_NAK */
#endif
#ifndef HEARS_LATE
#define HEARS_LATE 0 /* an update command between the window's end and the application */
#endif
#ifndef RESET_RESTARTS
#define RESET_RESTARTS 0
#endif
#ifndef RESTART_BY_RESET
#define RESTART_BY_RESET 0
#endif

/* -- messages */
#ifndef FRAME_GAP_US
#define FRAME_GAP_US 120000 /* the longest time between two frames of a message */
#endif
#ifndef JUNK_LOSES
#define JUNK_LOSES 0 /* a message has to begin with its frame */
#endif
#ifndef RESCANS
#define RESCANS 1 /* bytes of a frame after a wrong tail */
#endif
#ifndef SHORT_FRAMES_REJECTED
#define SHORT_FRAMES_REJECTED 0
#endif
#ifndef PADDING_IGNORED
#define PADDING_IGNORED 1
#endif
#ifndef FEEDBACK
#define FEEDBACK 0 /* general feedback: 1 to other writes, 2 to those of the upgrade too */
#endif
#ifndef RESET_FEEDBACK
#define RESET_FEEDBACK 0 /* and to a reset */
#endif

/* -- the update command */
#ifndef UPDATE_NAK
#define UPDATE_NAK 0
#endif
#ifndef REQUEST_US
#define REQUEST_US 0 /* from the update command to the request, at least */
#endif
#ifndef ERASE_IN_PASSES
#define ERASE_IN_PASSES 1 /* listens between two sectors */
#endif
#ifndef ERASING_HEARS
#define ERASING_HEARS 0 /* the update command again during the erase */
#endif
#ifndef ERASES_AGAIN
#define ERASES_AGAIN 0 /* for each of these */
#endif
#ifndef BEFORE_FIRST
#define BEFORE_FIRST 0 /* an update command before packet 1: 0 ignored, 1 request again, 2 erase again */
#endif
#ifndef UPDATE_RESTARTS
#define UPDATE_RESTARTS 1 /* an update command after packet 1 */
#endif

/* -- the transfer */
#ifndef ACK_US
#define ACK_US 0
#endif
#ifndef NAK_US
#define NAK_US 0
#endif
#ifndef WRONG_PACKET
#define WRONG_PACKET 1 /* 0 silence, 1 NAK with the number expected, 2 with the one received */
#endif
#ifndef DAMAGED_PACKET
#define DAMAGED_PACKET 1 /* likewise */
#endif
#ifndef DAMAGED_ANY
#define DAMAGED_ANY 1 /* each damaged message may be a packet */
#endif
#ifndef LOST_FRAME_NAKS
#define LOST_FRAME_NAKS 0
#endif
#ifndef BEYOND_ASKS_LAST
#define BEYOND_ASKS_LAST 0 /* the number expected after the last packet is that of the last one */
#endif
#ifndef REPEATED_NAKS_NEXT
#define REPEATED_NAKS_NEXT 0
#endif
#ifndef OLDER_PACKET
#define OLDER_PACKET 1 /* 0 silence, 1 ACK, 2 NAK with the number expected, 3 with the one received */
#endif
#ifndef FILLER_CHECKED
#define FILLER_CHECKED 0
#endif
#ifndef RESET_RESTARTS_TRANSFER
#define RESET_RESTARTS_TRANSFER 0
#endif
#ifndef PAUSE_US
#define PAUSE_US 0 /* a pause that ends the transfer; 0: none does */
#endif
#ifndef PAUSE_COUNTS
#define PAUSE_COUNTS 0 /* from 0 any message of the upgrade, 1 any packet, 2 a packet that makes sense */
#endif
#ifndef WRITE_ERROR_NAKS
#define WRITE_ERROR_NAKS 0 /* to each packet after a flash error; else to the end */
#endif

/* -- the end */
#ifndef EARLY_END_FAILS
#define EARLY_END_FAILS 0
#endif
#ifndef DAMAGED_END_NAKS
#define DAMAGED_END_NAKS 0
#endif
#ifndef END_NAK
#define END_NAK 0 /* its number: 0, 1 the last packet, 2 the number after that */
#endif
#ifndef END_NAK_US
#define END_NAK_US 0
#endif
#ifndef COMPLETE_US
#define COMPLETE_US 0
#endif
#ifndef END_ANSWERS_AGAIN
#define END_ANSWERS_AGAIN 1
#endif
#ifndef COMPLETE_RESTARTS
#define COMPLETE_RESTARTS 0
#endif
#ifndef REFUSED_US
#define REFUSED_US 0 /* from the refusal to the restart */
#endif

/* -- flash */
#ifndef BANKS
#define BANKS 1 /* 1; 2: the second bank is copied; 3: the banks are exchanged, sector by sector */
#endif
#ifndef RECORD_FIRST
#define RECORD_FIRST 0 /* the record lies before the application */
#endif
#ifndef ERASE
#define ERASE 0 /* 0 the whole bank, 1 what the image needs, 2 as packets come */
#endif
#ifndef RECORD_DROPPED_LATE
#define RECORD_DROPPED_LATE 0 /* with ERASE 2: the old application stays until the first write */
#endif
#ifndef PAGE_BYTES
#define PAGE_BYTES 128 /* written at once, a multiple of 128 and WRITE_BYTES */
#endif
#ifndef ACKS_FIRST
#define ACKS_FIRST 0 /* writes a page after its last packet is acknowledged */
#endif
#ifndef LAST_AT_END
#define LAST_AT_END 0 /* writes the last page at end of transfer */
#endif
#ifndef UNIT_BY_UNIT
#define UNIT_BY_UNIT 0 /* one call for each WRITE_BYTES */
#endif
#ifndef SKIPS_BLANK
#define SKIPS_BLANK 0 /* does not write units of FF */
#endif
#ifndef VERIFIES
#define VERIFIES 1 /* compares what it wrote, else only at the end */
#endif
#ifndef RETRIES
#define RETRIES 1
#endif
#ifndef COPIES_BEFORE_COMPLETE
#define COPIES_BEFORE_COMPLETE 0
#endif
#ifndef KEEPS_SECOND
#define KEEPS_SECOND 0 /* BANKS 2: the second bank stays as a spare copy */
#endif
#ifndef IMAGE_CHECKSUM
#define IMAGE_CHECKSUM 0
#endif

#define SECTORS(bytes) (((bytes) + SECTOR_BYTES - 1) / SECTOR_BYTES)
#define BANK_BYTES (SECTORS(APPLICATION_BYTES) * SECTOR_BYTES)
#define UNIT_BYTES (WRITE_BYTES < 16 ? 16 : WRITE_BYTES) /* of a record */
#define JOURNAL_BYTES (SECTORS((3 * SECTORS(APPLICATION_BYTES) + 24) * UNIT_BYTES) * SECTOR_BYTES)

#define RECORD_AT (RECORD_FIRST ? 0 : BANK_BYTES)
#define APPLICATION_AT (RECORD_FIRST ? SECTOR_BYTES : 0)
#define SECOND_AT (BANK_BYTES + SECTOR_BYTES)
#define ORDER_AT (SECOND_AT + BANK_BYTES)
#define SCRATCH_AT (ORDER_AT + SECTOR_BYTES)
#define JOURNAL_AT (SCRATCH_AT + SECTOR_BYTES)
#define FLASH_BYTES (BANKS == 1 ? SECOND_AT : BANKS == 2 ? SCRATCH_AT : JOURNAL_AT + JOURNAL_BYTES)

#endif
