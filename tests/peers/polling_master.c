/* Another master on libmodbus: polling_master PORT BAUD COUNT polls drives 1 and 2, commands drive 1 once, and prints what it
 * read last, one line a block: ADDRESS FIRST WORD WORD ... */

#include <errno.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>

static const int blocks[][2] = {{2100, 11}, {2000, 3}, {7, 2}};
enum { DRIVES = 2, BLOCKS = 3 };

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    return 1;
}

int main(int argc, char **argv) {
    if (argc != 4) {
        fprintf(stderr, "usage: polling_master PORT BAUD COUNT\n");
        return 2;
    }
    modbus_t *bus = modbus_new_rtu(argv[1], atoi(argv[2]), 'N', 8, 1);
    if (bus == NULL || modbus_set_response_timeout(bus, 30, 0) != 0 || modbus_connect(bus) != 0) return failed(argv[1]);
    static uint16_t read[DRIVES][BLOCKS][16];
    const uint16_t command[] = {1, 0, 4000};
    if (modbus_set_slave(bus, 1) != 0 || modbus_write_registers(bus, 2000, 3, command) != 3) return failed("write");
    for (long done = 1; done < atol(argv[3]);) {
        for (int drive = 0; drive < DRIVES; drive++) {
            if (modbus_set_slave(bus, drive + 1) != 0) return failed("address");
            for (int block = 0; block < BLOCKS; block++, done++) {
                if (modbus_read_registers(bus, blocks[block][0], blocks[block][1], read[drive][block]) != blocks[block][1])
                    return failed("read");
            }
        }
    }
    for (int drive = 0; drive < DRIVES; drive++) {
        for (int block = 0; block < BLOCKS; block++) {
            printf("%d %d", drive + 1, blocks[block][0]);
            for (int word = 0; word < blocks[block][1]; word++) printf(" %u", read[drive][block][word]);
            printf("\n");
        }
    }
    modbus_close(bus);
    modbus_free(bus);
    return 0;
}
