/* A Modbus TCP server on libmodbus: epoll, one thread, eleven holding registers from 2100. Prints its port. */
#include <errno.h>
#include <modbus.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

static void watch(int epoll, int fd) {
    struct epoll_event event = {.events = EPOLLIN, .data.fd = fd};
    if (epoll_ctl(epoll, EPOLL_CTL_ADD, fd, &event) != 0) {
        perror("epoll_ctl");
        exit(1);
    }
}

int main(void) {
    modbus_t *context = modbus_new_tcp("127.0.0.1", 0);
    modbus_mapping_t *mapping = modbus_mapping_new_start_address(0, 0, 0, 0, 2100, 11, 0, 0);
    int listener = context && mapping ? modbus_tcp_listen(context, 128) : -1;
    int epoll = epoll_create1(0);
    struct sockaddr_in address;
    socklen_t length = sizeof address;
    if (listener < 0 || epoll < 0 || getsockname(listener, (struct sockaddr *)&address, &length) != 0) {
        perror("libmodbus");
        return 1;
    }
    for (int i = 0; i < 11; i++)
        mapping->tab_registers[i] = 1000 + i;
    printf("%d\n", ntohs(address.sin_port));
    fflush(stdout);
    watch(epoll, listener);
    /* The parent closes standard input at the end. */
    watch(epoll, 0);
    for (;;) {
        struct epoll_event events[64];
        int count = epoll_wait(epoll, events, 64, -1);
        for (int i = 0; i < count; i++) {
            int fd = events[i].data.fd;
            if (fd == 0)
                return 0;
            if (fd == listener) {
                int client = modbus_tcp_accept(context, &listener);
                if (client >= 0)
                    watch(epoll, client);
                continue;
            }
            unsigned char query[MODBUS_TCP_MAX_ADU_LENGTH];
            modbus_set_socket(context, fd);
            int received = modbus_receive(context, query);
            if (received > 0)
                modbus_reply(context, query, received, mapping);
            else if (received < 0)
                close(fd);
        }
    }
}
