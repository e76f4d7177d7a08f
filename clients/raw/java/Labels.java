import coseg.v1.*;
import java.nio.*;
import java.nio.file.*;
import java.util.*;
import org.zeromq.*;

public class Labels {
    static final ZMQ.Socket socket = ZMQ.context(1).socket(ZMQ.DEALER);

    static List<byte[]> call(Message.Request.Builder request, byte[]... frames) throws Exception {
        ZMsg message = new ZMsg();
        message.add(request.setClientId("raw-java").build().toByteArray());
        for (byte[] frame : frames) message.add(frame);
        message.send(socket);
        List<byte[]> reply = new ArrayList<>();
        for (ZFrame frame : ZMsg.recvMsg(socket)) reply.add(frame.getData());
        Message.Reply header = Message.Reply.parseFrom(reply.get(0));
        if (header.hasError()) throw new Exception(header.getError().getMessage());
        return reply;
    }

    public static void main(String[] args) throws Exception {
        socket.setReceiveTimeOut(60_000);
        socket.connect(args[0]); // tcp://HOST:PORT, since this library has no Unix sockets
        var encoded = JobOuterClass.EncodedMesh.newBuilder().setFormat(JobOuterClass.MeshFormat.MESH_FORMAT_OFF);
        encoded.setBytes(Array.BytesRef.newBuilder().setFrame(0));
        var add = JobOuterClass.AddShapesRequest.newBuilder().setCollection("raw");
        add.setMode(JobOuterClass.AddMode.ADD_MODE_WAIT).setCreate(CollectionOuterClass.CollectionSpec.newBuilder());
        add.addShapes(JobOuterClass.ShapeInput.newBuilder().setName("java").setEncoded(encoded));
        call(Message.Request.newBuilder().setRequestId("add").setAddShapes(add), Files.readAllBytes(Path.of(args[1])));
        var get = ShapeOuterClass.GetLabelsRequest.newBuilder().setCollection("raw").setShape("java");
        List<byte[]> reply = call(Message.Request.newBuilder().setRequestId("labels").setGetLabels(get));
        int frame = Message.Reply.parseFrom(reply.get(0)).getGetLabels().getLabels().getFrame();
        IntBuffer labels = ByteBuffer.wrap(reply.get(1 + frame)).order(ByteOrder.LITTLE_ENDIAN).asIntBuffer();
        StringJoiner line = new StringJoiner(" ");
        while (labels.hasRemaining()) line.add("" + labels.get());
        System.out.println(line);
        System.exit(0); // the context's threads would keep running
    }
}
