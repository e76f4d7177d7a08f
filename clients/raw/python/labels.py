import array, sys, zmq
from coseg.v1 import message_pb2 as m

socket = zmq.Context().socket(zmq.DEALER)
socket.RCVTIMEO = 60_000
socket.connect(sys.argv[1])

def call(request_id, *frames, **body):
    request = m.Request(request_id=request_id, client_id="raw-python", **body)
    socket.send_multipart([request.SerializeToString(), *frames])
    header, *raw = socket.recv_multipart()
    reply = m.Reply.FromString(header)
    if reply.WhichOneof("result") == "error":
        raise SystemExit(reply.error.message)
    return getattr(reply, reply.WhichOneof("result")), raw

mesh = open(sys.argv[2], "rb").read()
shape = {"name": "python", "encoded": {"format": "MESH_FORMAT_OFF", "bytes": {"frame": 0}}}
call("add", mesh, add_shapes={"collection": "raw", "shapes": [shape], "create": {}, "mode": "ADD_MODE_WAIT"})
reply, raw = call("labels", get_labels={"collection": "raw", "shape": "python"})
print(*array.array("i", raw[reply.labels.frame]))
