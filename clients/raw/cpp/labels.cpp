#include <fstream>
#include <iostream>
#include <iterator>
#include <zmq_addon.hpp>
#include "coseg/v1/message.pb.h"

using namespace coseg::v1;

zmq::multipart_t call(zmq::socket_t& socket, const Request& request, Reply& reply, std::string frame = {}) {
    zmq::multipart_t message(request.SerializeAsString());
    if (!frame.empty()) message.addstr(frame);
    message.send(socket);
    if (!message.recv(socket)) throw std::runtime_error("no answer");
    reply.ParseFromString(message.popstr());
    if (reply.has_error()) throw std::runtime_error(reply.error().message());
    return message;
}

int main(int, char** argv) {
    zmq::context_t context;
    zmq::socket_t socket(context, zmq::socket_type::dealer);
    socket.set(zmq::sockopt::rcvtimeo, 60'000);
    socket.set(zmq::sockopt::linger, 0);
    socket.connect(argv[1]);
    std::ifstream file(argv[2], std::ios::binary);
    Request add, labels;
    Reply reply;
    add.set_request_id("add"), add.set_client_id("raw-cpp");
    add.mutable_add_shapes()->set_collection("raw");
    add.mutable_add_shapes()->set_mode(ADD_MODE_WAIT);
    add.mutable_add_shapes()->mutable_create();
    ShapeInput* shape = add.mutable_add_shapes()->add_shapes();
    shape->set_name("cpp");
    shape->mutable_encoded()->set_format(MESH_FORMAT_OFF);
    shape->mutable_encoded()->mutable_bytes()->set_frame(0);
    call(socket, add, reply, {std::istreambuf_iterator<char>(file), {}});
    labels.set_request_id("labels");
    labels.mutable_get_labels()->set_collection("raw");
    labels.mutable_get_labels()->set_shape("cpp");
    zmq::multipart_t raw = call(socket, labels, reply);
    const zmq::message_t& frame = raw.at(reply.get_labels().labels().frame());
    for (size_t i = 0; i < frame.size() / 4; ++i) std::cout << (i ? " " : "") << frame.data<int32_t>()[i];
    std::cout << std::endl;
}
